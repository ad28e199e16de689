"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "the other axis's step": ("cpu", "_look_up", "ny * width, width, fx, fy", "nz * width, width, fx, fy"),
    "the band before is forgotten": ("cpu", "_spread_planes", "row + 1 < begin", "row < begin"),
    "a weight of the line for the plane": ("cpu", "_spread_planes", "to_plane * (f * g)", "to_plane * (f * h)"),
    "gradient of another product": ("cpu", "_spread_planes", "(i * 3 + mode) * width + c, ", "i * 3 * width + c, "),
    "own factor instead of another's": ("cpu", "_spread_lines", "slope * a * d", "slope * b * d"),
    "a weight of the other side": ("gpu", "_add_line", "x * f[:, None]", "x * (1 - f)[:, None]"),
    "factor forgotten": ("gpu", "_backward", "to_b * p", "to_b"),
    "own factor instead of another's, on the gpu": ("gpu", "_backward", "slope * a * d", "slope * b * d"),
}

ASTRAY = {"the point 1.0, a node too far": ("cpu", "_place", "np.int64(s), n - 2)", "np.int64(s), n - 1)")}
