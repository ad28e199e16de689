"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "another prime": ("cpu", "slot_of", "np.int64(y) * P2", "np.int64(y) * P3"),
    "two slots on": ("cpu", "_insert", "(slot + 1) & mask", "(slot + 3) & mask"),
    "another prime, on the gpu": ("gpu", "slot_of", "z.to(tl.int64) * P3", "z.to(tl.int64) * P1"),
    "nothing evicted": ("cpu", "_insert", "table[slot] < number", "False"),
    "the larger number goes on": ("gpu", "_insert", "tl.minimum(number, before)", "tl.maximum(number, before)"),
}

ASTRAY = {"no end of the table": ("cpu", "_insert", "(slot + 1) & mask", "slot + 1")}
