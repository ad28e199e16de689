"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "another order": ("cpu", "_signatures", "x + column] < padded", "x + column] > padded"),
    "a column aside": ("cpu", "_costs", "width - 1 - x + first", "width - x + first"),
    "no limit of grey": (
        "cpu",
        "_costs",
        "min(np.uint8(np.uint8(max(g, b) - min(g, b)) >> SHIFT), CAP)",
        "np.uint8(np.uint8(max(g, b) - min(g, b)) >> SHIFT)",
    ),
    "masks forgotten": ("cpu", "_costs", "max(unlike & seen[start + k], UNSEEN & ~seen[start + k])", "unlike"),
    "half the bits": ("cpu", "_bits", "int(x)", "int(x & 0x7FFF)"),
    "another direction": ("gpu", "_costs", "column - first - i % count", "column - first + i % count"),
    "no limit of grey, on the gpu": (
        "gpu",
        "_costs",
        "tl.minimum(tl.abs(a - b) >> SHIFT, CAP)",
        "(tl.abs(a - b) >> SHIFT)",
    ),
    "another row": ("gpu", "_signatures", "y * width + x", "x"),
}

ASTRAY = {"beyond the row": ("cpu", "_costs", "max(min(width - begin, count), low)", "count")}
