"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "the least not taken away": ("cpu", "_advance", "limit) - least)", "limit))"),
    "no way up a slope": ("cpu", "_advance", "min(L[before + k - ONE], L[before + k + ONE])", "L[before + k - ONE]"),
    "another edge": ("cpu", "_sweep", "y - towards)", "y)"),
    "one direction twice": ("cpu", "_sweep", "(i - 2 + r, 1 - now)", "(i - 1, 1 - now)"),
    "a sweep forgotten": ("cpu", "_winners", "totals[down + k] + totals[up + k]", "2 * totals[down + k]"),
    "a rival beside": ("cpu", "_winners", "np.uint64(k + 2)", "np.uint64(k + 1)"),
    "the last of equal ones": ("cpu", "_winners", "met < best", "met <= best"),
    "a path that wraps": ("gpu", "_path", "(step == 0) | (x - DX < 0) | (x - DX >= width)", "step == 0"),
    "an edge unseen": ("gpu", "_path", "tl.where(begins, pixel, before)", "pixel"),
    "another right pixel": ("gpu", "_winners", "pixel % width + first + k", "pixel % width - first + k"),
}

ASTRAY = {"beyond the row": ("cpu", "_winners", "min(nearest, width - 1) + 1", "nearest + 1")}
