"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "through the wrong side": ("cpu", "leave", "u = hx if ix > ZERO else lx - 1", "u = hx"),
    "a node too deep": ("cpu", "shared", "differing >> (depth - level)", "differing >> (depth - level + 1)"),
    "spent, yet going on": ("cpu", "_walk", "thickness > most", "thickness > 2 * most"),
    "another octant": ("gpu", "leaf", "4 * ((x >> s) & 1)", "2 * ((x >> s) & 1)"),
    "spent, yet going on, on a gpu": ("gpu", "_walk", "thickness <= most", "thickness <= 2 * most"),
}

ASTRAY = {"the cell after the last": ("cpu", "_walk", "i = starts[r] + count", "i = starts[r] + count + 1")}
