"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "a neighbour's slope forgotten": ("gpu", "_vary", "dy / length", "0 * dy"),
    "an axis forgotten": ("gpu", "_vary", "dz * dz + EPSILON_", "EPSILON_"),
    "slope's sign": ("cpu", "_vary", "out[down, c] += per * dy", "out[down, c] -= per * dy"),
    "a node's own slope forgotten": ("cpu", "_vary", "per * (dx + dy + dz)", "per * (dx + dy)"),
}

ASTRAY = {"after the last node": ("cpu", "_after", "x >= index.shape[0]", "x > index.shape[0]")}
