"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "nothing behind the surface": ("cpu", "_walk", "in range(steps + 1)", "in range(steps // 2)"),
    "held blocks are new": ("cpu", "_walk", "find(x, y, z, blocks, table) >= 0", "False"),
    "blocks twice": ("cpu", "_walk", "new[i, 2] == z", "False"),
    "corners of pixels": ("cpu", "_walk", "np.float32(pixel // width) + HALF", "np.float32(pixel // width)"),
    "rays longer than one": ("gpu", "direction", "1 / tl.sqrt(u * u + v * v + 1)", "1.0"),
    "held blocks are new, on the gpu": ("gpu", "_walk", "find(x, y, z, blocks, table, mask, here) < 0", "t > 0"),
}

ASTRAY = {
    "the pixel after the last": (
        "cpu",
        "_walk",
        "depth[pixel // width, pixel % width]",
        "depth[pixel // width, pixel + 1]",
    )
}
