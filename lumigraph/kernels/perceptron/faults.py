"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "a layer that no gate closes": ("cpu", "_backward", "layer == 0)", "True)"),
    "the wrong gate": ("cpu", "_downwards", "target, gate, _gated", "target, target, _gated"),
    "the last block's rest counted twice": (
        "cpu",
        "_fetch",
        "block[(row + f) * BLOCK : (row + f + 1) * BLOCK] = 0",
        "pass",
    ),
}

ASTRAY = {"a tile too many": ("cpu", "_product", "whole = count - count % TILE\n", "whole = count\n")}
