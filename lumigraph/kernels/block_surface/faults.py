"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "vertices of this block alone": ("cpu", "_write", "starts[held] + (code >> 3)", "starts[number] + (code >> 3)"),
    "the other end": (
        "cpu",
        "_write",
        "d[i, j, k] / (d[i, j, k] - d[a, b, c])",
        "d[a, b, c] / (d[a, b, c] - d[i, j, k])",
    ),
    "weights forgotten": ("cpu", "_fill", "voxels[held, row, 1] > min_weight", "voxels[held, row, 1] >= ZERO"),
    "a colour of nothing": ("cpu", "_write", "voxels[held, other, 2] < ZERO", "False"),
    "edges miscounted": ("cpu", "_write", "(before & 1) + (before >> 1)", "before"),
    "weights forgotten, on the gpu": ("gpu", "_distance", "> min_weight", ">= min_weight"),
    "vertices of this block alone, on the gpu": (
        "gpu",
        "_write",
        "tl.load(starts + held, mask",
        "tl.load(starts + block + held * 0, mask",
    ),
    "another axis": ("gpu", "_crosses", "(1 if axis == 1 else 0)", "(1 if axis == 2 else 0)"),
}

ASTRAY = {"a neighbour's neighbour": ("cpu", "_fill", "((i & 7) << 6)", "(i << 6)")}
