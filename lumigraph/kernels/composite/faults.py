"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "sign": ("gpu", "_backward", " - gw_behind", " + gw_behind"),
    "off-by-one transmittance": ("gpu", "_backward", "tl.exp(-in_front - t)", "tl.exp(-in_front)"),
    "opacity forgotten": ("gpu", "_backward", "1) + g_opacity +", "1) +"),
    "gradient behind the stop": ("gpu", "_backward", "tl.where(seen, ", "tl.where(i < b, "),
    "attenuation forgotten": ("cpu", "_backward", "g * transmittance - sum_gw", "g * transmittance"),
}

ASTRAY = {"a weight of the next sample": ("cpu", "_forward", "weights[i] = w", "weights[i + 1] = w")}
