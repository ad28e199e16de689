"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "the samples behind forgotten": ("cpu", "_backward", "weight -= weights[i]", "weight -= 0"),
    "each pair once": ("cpu", "_forward", "2 * (m * weight - moment)", "m * weight - moment"),
    "a sample's own length forgotten": ("gpu", "_backward", " + w * d / 3", ""),
    "sums of one block": ("gpu", "_backward", "weight += 2 * tl.sum(w, 0)", "weight += 0 * tl.sum(w, 0)"),
    "a sample before itself": ("gpu", "_forward", "tl.cumsum(w * m, 0) - w * m", "tl.cumsum(w * m, 0)"),
}

ASTRAY = {"a gradient of the next sample": ("cpu", "_backward", "to_weights[i] = ", "to_weights[i + 1] = ")}
