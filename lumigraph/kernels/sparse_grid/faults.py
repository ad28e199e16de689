"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "corner forgotten": ("gpu", "_backward_values", "tl.static_range(8)", "tl.static_range(7)"),
    "weight forgotten": ("gpu", "_backward_values", "weight[:, None] * g", "g"),
    "slope's sign": ("gpu", "slope_of", "(k % 2 * 2 - 1)", "(1 - k % 2 * 2)"),
    "clamped, yet with gradient": ("gpu", "_backward_points", "where(inside[1]", "where(here"),
    "gradient of another sample": ("cpu", "_value_gradient", "grad[i, c]", "grad[j, c]"),
    "slope's sign on the cpu": ("cpu", "_point_gradient", "(2 * y - 1)", "(1 - 2 * y)"),
    "empty nodes as the first row": ("cpu", "corners", "count += row >= 0", "count += 1"),
}

ASTRAY = {"the point 1.0, a cell too far": ("cpu", "cell_of", "np.int64(cells - 1))\n", "np.int64(cells))\n")}
