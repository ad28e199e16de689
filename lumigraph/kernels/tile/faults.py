"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "the circle for the ellipse": ("cpu", "_span", " - ellipse[4] * y\n    y =", "\n    y ="),
    "equal depths the other way round": ("cpu", "_near_first", "= order[k]", "= order[-1 - k]"),
    "a column too many": ("cpu", "_hand_out", "- side + HALF", "- side - ONE"),
    "the box for the ellipse": ("gpu", "_tile", "& (least <= reach)", ""),
    "a tile too few": ("gpu", "_span", "last - first + 1", "last - first"),
    "another row's tile": ("gpu", "_tile", "row * across + column", "column * down + row"),
}

ASTRAY = {"room for one tile in each row": ("cpu", "_room", " * rows[k, 2]", "")}
