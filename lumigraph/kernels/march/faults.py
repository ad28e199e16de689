"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "empty cells counted": ("gpu", "_march", "count += kept", "count += held"),
    "a cell too far": ("gpu", "_first_at", "- 0.02)", "+ 1.0)"),
    "spent, yet going on": ("gpu", "_march", "alive &= thickness <= most", "pass"),
    "spent, yet going on, on the cpu": ("cpu", "_walk", "thickness > depth_limit", "thickness > 2 * depth_limit"),
}

ASTRAY = {"the ray after the next": ("cpu", "_write", "starts[r + 1] - starts[r]", "starts[r + 2] - starts[r]")}
