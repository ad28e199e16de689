"""Faults that the tests write into a copy of an engine, one at a time, to see their comparison turn red.

By name: the engine, the function, what stands there, and what is put in its place.
"""

FAULTS = {
    "half a pixel aside": ("cpu", "_look_up", "v0) * inverse + HALF", "v0) * inverse"),
    "what lies behind is seen": ("cpu", "_look_up", "+ ONE) if s > LEAST else ZERO", "+ ONE)"),
    "trust forgotten": ("cpu", "_look_up", "t * its * its /", "its * its /"),
    "the most instead of the least": ("cpu", "_keep_least", "= max(c, lower)", "= min(c, lower)"),
    "a row of long ago": ("cpu", "_sweep", "sums[:] = ZERO", "pass"),
    "a mean forgotten": ("gpu", "_costs", "- mean_a * mean_b", "- mean_a"),
    "what lies behind is seen, on the gpu": ("gpu", "_costs", "before = s > LEAST", "before = s > -1e9"),
    "another neighbour's warp": ("gpu", "_costs", "warps + 12 * neighbour", "warps"),
}

# These let an index leave its array.
ASTRAY = {
    "no border behind": ("cpu", "_look_up", "lowest + ONE)", "lowest + ONE + ONE)"),
}
