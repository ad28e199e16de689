"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "half a pixel aside": ("cpu", "_cost", "* inverse + HALF\n        u = min", "* inverse\n        u = min"),
    "a plane behind is seen": ("cpu", "_cost", "right) if s > MIN_DEPTH else ZERO", "right)"),
    "a slope forgotten": ("cpu", "_cost", "warps[n, 0, 1] + g_ * warps[n, 0, 3]", "warps[n, 0, 1]"),
    "trust forgotten": ("cpu", "_window", "trust[y, x] * np.exp", "np.exp"),
    "weights without colour": ("cpu", "_window", "-value * value * sharpness - apart[k]", "-apart[k]"),
    "another view": ("cpu", "_costs", "n = views[p, i]", "n = views[p, 0]"),
    "a border without trust": ("cpu", "_cost", "max(min(min(u, right - u), ONE), ZERO)", "ONE"),
    "a mean forgotten": ("gpu", "_costs", "- mean_a * mean_b", "- mean_a"),
    "a plane behind is seen, on the gpu": ("gpu", "_costs", "before = s > MIN_DEPTH", "before = s > -1e9"),
    "another neighbour's warp": ("gpu", "_costs", "warps + 12 * neighbour", "warps + 0 * neighbour"),
    "another plane": ("gpu", "_costs", "3 * (p * planes + m)", "3 * (p * planes)"),
}

ASTRAY = {"no border behind": ("cpu", "_cost", "np.float32(rows + 1)", "np.float32(rows + 2)")}
