"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "held, yet with gradient": ("gpu", "_lens_backward", "where(x == X", "where(z > 0"),
    "a lens's second slope": ("gpu", "_bend_backward", "6 * p2", "2 * p2"),
    "blur in the compensation": ("gpu", "_covariance_backward", "(a + c - blur)", "(a + c)"),
    "a quaternion's length": ("gpu", "_matrix_backward", "along * y", "0 * y"),
    "a colour below zero": ("gpu", "_backward", "colour[1] > 0", "seen"),
    "the direction's length": ("gpu", "_backward", "-_dot(d, d_d)", "0.0"),
    "a lens's second slope on the cpu": ("cpu", "_curve", "SIX * p2", "TWO * p2"),
    "held, yet with gradient on the cpu": ("cpu", "_pull", "where(over != ZERO, ZERO, g_x)", "g_x"),
    "the direction's length on the cpu": ("cpu", "_pull", "tx - dx * inward", "tx"),
    "the cross product's order": ("cpu", "_pulled", "grow * nT[n]", "ZERO - grow * nT[n]"),
}

ASTRAY = {"a coefficient too few": ("cpu", "_forward", "np.empty(16 *", "np.empty(15 *")}
