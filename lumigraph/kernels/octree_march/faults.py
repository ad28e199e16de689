"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "attenuation forgotten": ("cpu", "_share", "g * transmittance - sum_gw", "g * transmittance"),
    "slope of the sigmoid forgotten": ("cpu", "_share", "* colour * (ONE - colour)", ""),
    "length forgotten": ("cpu", "_share", "- sum_gw) * length", "- sum_gw)"),
    "another ray's direction": ("cpu", "_sum", "bases[r, k]", "bases[0, k]"),
    "sign": ("gpu", "_backward", "transmittance - sum_gw", "transmittance + sum_gw"),
    "opacity forgotten": ("gpu", "_backward", "g = g_opacity +", "g ="),
    "coefficient of the next": ("gpu", "_backward", "row * (3 * BASIS) + 3 * k", "row * (3 * BASIS) + k"),
    "distance to the far side": ("gpu", "_forward", "0.5 * (t + end)", "end"),
}

ASTRAY = {"a share of the next ray": ("cpu", "_share", "rows[i], rays[i] = row, r", "rows[i], rays[i + 1] = row, r")}
