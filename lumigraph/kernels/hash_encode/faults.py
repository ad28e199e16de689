"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "corner forgotten": ("gpu", "_backward_table", "tl.static_range(8)", "tl.static_range(7)"),
    "weight forgotten": ("gpu", "_backward_table", "weight[:, None] * g", "g"),
    "slope's sign": ("gpu", "_backward_points", "dx += ", "dx -= "),
    "clamped, yet with gradient": ("gpu", "_backward_points", "where(inside[1]", "where(here"),
    "gradient of another sample": ("cpu", "_table_gradient", "plane + first + i", "plane + first"),
    "corner forgotten on the cpu": ("cpu", "blend", "range(1, 8)", "range(1, 7)"),
    "sides mistaken": ("cpu", "_along", "ONE - share, share", "share, ONE - share"),
    "slope's sign on the cpu": ("cpu", "_point_gradient", "(2 * by - 1)", "(1 - 2 * by)"),
}

ASTRAY = {
    "the entry after the last": ("cpu", "_corners", "(entry + np.uint32(base))", "(entry + np.uint32(base + 1))"),
    "the point 1.0, a cell too far": ("cpu", "_along", "np.uint32(resolution - 1)", "np.uint32(resolution)"),
}
