"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "half a pixel aside": ("cpu", "_place", "v0) * inverse + HALF", "v0) * inverse"),
    "what lies behind is seen": ("cpu", "_place", "before = s > MIN_DEPTH", "before = s != ZERO"),
    "trust forgotten": ("cpu", "_products", "w, wb = trust[x] * seen[x], trust[x]", "w, wb = trust[x] * seen[x], ONE"),
    "the most instead of the least": ("cpu", "_keep_least", "= max(c, lower)", "= min(c, lower)"),
    "a row of long ago": ("cpu", "_sweep", "sums[:] = ZERO", "pass"),
    "a mean forgotten": ("gpu", "_costs", "- mean_a * mean_b", "- mean_a"),
    "what lies behind is seen, on the gpu": ("gpu", "_costs", "before = s > MIN_DEPTH", "before = s > -1e9"),
    "another neighbour's warp": ("gpu", "_costs", "warps + 12 * neighbour", "warps"),
}

ASTRAY = {"no border behind": ("cpu", "_place", "np.float32(rows + 1)", "np.float32(rows + 2)")}
