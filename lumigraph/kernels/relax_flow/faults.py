"""Seeded faults by name: engine, function, a piece of it, its replacement. In ASTRAY an index leaves its array."""

FAULTS = {
    "a neighbour twice": ("cpu", "_half_step", "flow[y, x - 1, 0]", "flow[y, x, 0]"),
    "another weight": ("cpu", "_half_step", "w = below[y - 1, x]", "w = below[y, x]"),
    "one colour only": ("cpu", "_half_step", "(y + odd) % 2", "y % 2"),
    "no relaxation": ("cpu", "_half_step", "+= relaxation * (u", "+= (u"),
    "another side": ("gpu", "_half_step", "right, i, -1, i - 1", "right, i, 1, i - 1"),
    "v before u": ("gpu", "_half_step", "(v - b * own_u)", "(v - b * u)"),
    "colours as one": ("gpu", "_half_step", "% 2 == odd", "% 1 == 0"),
}

ASTRAY = {"beyond the last row": ("cpu", "_half_step", "if y + 1 < height", "if y < height")}
