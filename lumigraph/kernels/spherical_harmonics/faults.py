"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "sign in band 3": ("gpu", "harmonic", "z * z - 3", "z * z + 3"),
    "sign of a slope in band 3": (
        "gpu",
        "harmonic_slope",
        "(-3 * Y33), x * y * (6 * Y33)",
        "(3 * Y33), x * y * (6 * Y33)",
    ),
    "never written": ("gpu", "_backward", "(dx, dy, dz), here", "(dx, dy, dz), r < R - 1"),
    "term forgotten": ("cpu", "slope", " - zonal * g13", ""),
}

ASTRAY = {"a coefficient too many": ("cpu", "basis", "keep(out, 15,", "keep(out, 16,")}
