"""Seeded faults by name: engine, function, a piece of it, its replacement. In ASTRAY an index leaves its array."""

FAULTS = {
    "a mean forgotten": ("cpu", "_flow", "gx[k] - mean_x", "gx[k]"),
    "the wrong way": ("cpu", "_flow", "u -= ", "u += "),
    "no way back": ("cpu", "_flow", "> size", "> 1e9"),
    "another pixel": ("cpu", "_value", "fx * picture[below, right]", "fx * picture[below, left]"),
    "a template forgotten": ("gpu", "_flow", "height, width, here) - T", "height, width, here)"),
    "another row of patches": ("gpu", "_flow", "patch // columns * stride", "patch % columns * stride"),
    "a leap allowed": ("gpu", "_flow", "> count", "> 1e9"),
}

ASTRAY = {"beyond the last column": ("cpu", "_value", "min(left + 1, width - 1)", "left + 1")}
