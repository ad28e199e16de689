"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "light not lost": ("gpu", "_backward", "gw_behind / (1 - alpha)", "gw_behind"),
    "cut off, yet with gradient": ("gpu", "_backward", " & (raw <= MAX_ALPHA)", ""),
    "an opacity behind the stop": ("gpu", "_backward", " & (ended == 0)", ""),
    "all that is behind, again": ("gpu", "_backward", "rest -= tl.sum(w * g_w, 0)", "rest -= 0"),
    "the other axis": ("gpu", "_backward", "conic[2] * sum_y", "conic[0] * sum_y"),
    "a block too few": ("cpu", "_blocks", "np.float32(1.5)", "np.float32(0.5)"),
    "spent blocks visited": ("cpu", "_alpha", "& (transmittance >= stop)", "& (transmittance >= ZERO)"),
    "light not lost on the cpu": ("cpu", "_backward", "sum_gw / (ONE - alpha)", "sum_gw"),
    "0.99, yet with gradient on the cpu": ("cpu", "_backward", "alpha < MAX_ALPHA", "alpha >= ZERO"),
    "half a square": ("cpu", "_gather", "-HALF * dydy", "-dydy"),
    "only one block's sums": ("cpu", "_gather", "and masks[p]", "and masks[p] == 1"),
}

ASTRAY = {"a plane too few": ("cpu", "_forward", "BLOCKS * 5", "BLOCKS * 4")}
