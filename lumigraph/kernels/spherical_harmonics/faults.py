"""Seeded faults by name: the engine, the function, a piece of it, and what is put in its place."""

FAULTS = {
    "sign in band 3": ("gpu", "harmonic", "z * z - 3", "z * z + 3"),
    "sign of a slope in band 3": (
        "gpu",
        "harmonic_slope",
        "(-3 * Y33), x * y * (6 * Y33)",
        "(3 * Y33), x * y * (6 * Y33)",
    ),
    "never written": ("gpu", "_backward", "(dx, dy, dz), here", "(dx, dy, dz), r < R - 1"),
    "term forgotten": ("cpu", "slope", " - zonal * g[13]", ""),
}

# These let an index leave its array.
ASTRAY = {
    "a coefficient too many": ("cpu", "basis", "out[15] =", "out[16] ="),
}
