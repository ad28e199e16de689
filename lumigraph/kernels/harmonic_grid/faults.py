"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "corner forgotten": ("gpu", "_backward", "tl.static_range(8)", "tl.static_range(7)"),
    "weight forgotten": ("gpu", "_backward", "weight[:, None] * g", "g"),
    "another colour's coefficient": ("gpu", "_forward", "c[None, :] % 3 == colour", "c[None, :] // 9 == colour"),
    "direction of another sample": ("cpu", "_gradient", "if _turned(directions, i, before):", "if before < 0:"),
    "lanes of both registers, twice": ("cpu", "_gradient", "put_where(own, ", "put("),
    "density without weight": ("cpu", "_gradient", "weight * d_density[i]", "d_density[i]"),
}

ASTRAY = {
    "a register beyond the last row": (
        "cpu",
        "_look_up",
        "row * WIDTH + SECOND_REGISTER",
        "row * WIDTH + SECOND_REGISTER + 16",
    )
}
