"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "half a pixel aside": ("cpu", "_add_colour", "x = min(max(u - HALF", "x = min(max(u"),
    "depth half a pixel aside": ("cpu", "_gap", "y = min(max(v - HALF", "y = min(max(v + HALF"),
    "a point behind is seen": ("cpu", "_place", "if z <= MIN_DEPTH", "if z == ZERO"),
    "a lens without end": ("cpu", "_place", "s > lenses[n, 12] * lenses[n, 12]", "s < ZERO"),
    "hidden points count": ("cpu", "_blend", "ONE + hidden_weight * gap", "ONE"),
    "edges count as hidden": ("cpu", "_gap", "if t < NO_SURFACE else ZERO", "if t > ZERO else ZERO"),
    "resolution forgotten": ("cpu", "_blend", "+ resolution_weight * coarse", "+ ZERO * coarse"),
    "weights that jump": ("cpu", "_blend", "(ONE - penalties[k] / worst) / (", "ONE / ("),
    "borders count in full": ("cpu", "_blend", "penalty, min(share, ONE), n", "penalty, ONE, n"),
    "another view's pixel": ("gpu", "_colours", "places + 2 * (i * views + n)", "places + 2 * (i * views)"),
    "depth of another view": ("gpu", "_penalties", "n.to(tl.int64) * depth_rows * depth_columns", "0"),
    "a point behind is seen, on the gpu": ("gpu", "_penalties", "here & (z > MIN_DEPTH)", "here & (z != 0)"),
}

ASTRAY = {"a row below the last": ("cpu", "_gap", "min(top + 1, height - 1)", "top + 1 + height")}
