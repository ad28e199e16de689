"""Faults that the tests write into a copy of an engine, one at a time, to see their comparison turn red.

By name: the engine, the function, what stands there, and what is put in its place.
"""

FAULTS = {
    "sign in band 3": ("gpu", "_backward", "- sectoral * g15", "+ sectoral * g15"),
    "never written": ("gpu", "_backward", "d_directions + 3 * r + 2", "d_directions + 3 * r"),
    "term forgotten": ("cpu", "slope", " - zonal * g[13]", ""),
}

# These let an index leave its array.
ASTRAY = {
    "a coefficient too many": ("cpu", "basis", "out[15] =", "out[16] ="),
}
