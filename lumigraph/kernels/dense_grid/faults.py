"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "corner forgotten": ("gpu", "_backward_grid", "tl.static_range(8)", "tl.static_range(7)"),
    "weight forgotten": ("gpu", "_backward_grid", "weight[:, None] * g", "g"),
    "slope's sign": ("gpu", "_backward_points", "dx + slope[0]", "dx - slope[0]"),
    "clamped, yet with gradient": ("gpu", "_backward_points", "where(inside[1]", "where(here"),
    "sides mistaken": ("cpu", "_sides", "fy * (ONE - fz), (ONE - fy) * fz", "(ONE - fy) * fz, fy * (ONE - fz)"),
    "gradient of the first sample": ("cpu", "_grid_gradient", "spread(grad, i, n", "spread(grad, 0, n"),
    "plane of another thread, with weight": ("cpu", "_grid_gradient", "if above else ZERO", "if n else ZERO"),
    "slope's sign on the cpu": ("cpu", "_point_gradient", "(2 * by - 1)", "(1 - 2 * by)"),
}

ASTRAY = {"the point 1.0, a corner too far": ("cpu", "_axis", "np.int32(size - 2)", "np.int32(size - 1)")}
