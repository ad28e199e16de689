"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "depth along the axis": ("cpu", "_fuse", "np.sqrt(across + pz * pz)", "qz"),
    "a weight forgotten": ("cpu", "_fuse", "min(weight + w, max_weight)", "min(weight + ONE, max_weight)"),
    "no end of the weight": ("cpu", "_fuse", "min(weight + w, max_weight)", "weight + w"),
    "blocks at the border dropped": ("cpu", "_visible", "v + top * w < -slant_t", "v + top * w < slant_t"),
    "colours of free space": ("cpu", "_fuse", "if d < reach", "if d > -reach"),
    "mixed with no colour": ("cpu", "_fuse", "colour if fresh else own", "own"),
    "what lies beside a hole dropped": ("cpu", "_fuse", "if most < ZERO", "if not nearest > ZERO"),
    "a band that does not widen": ("cpu", "_fuse", "ONE + widening * surface", "ONE"),
    "depth along the axis, on the gpu": ("gpu", "_fuse", "tl.sqrt(px * px + py * py + pz * pz)", "qz"),
    "edges blended": ("gpu", "_fuse", "(farthest - nearest <= edge * nearest)", "(farthest < 1e9)"),
    "what is hidden is known": ("gpu", "_fuse", "(distance >= -reach)", "(distance >= -9)"),
    "another colour": ("gpu", "_fuse", "here, 3, channel)", "here, 3, 0)"),
}

ASTRAY = {"a pixel beyond the last": ("cpu", "_fuse", "min(left + 1, width - 1)", "left + 1")}
