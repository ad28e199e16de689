"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "one triangle is not followed": ("cpu", "_silhouette", "if beyond < 0:", "if beyond < len(faces):"),
    "a surface that turns away goes on": ("cpu", "_silhouette", "side > 0", "side > 1e9"),
    "the farther surface": ("cpu", "_find", "depth[row, column] <= depth", "depth[row, column] > depth"),
    "flat edges beside steep ones": ("cpu", "_crossing", "abs(a - b) > abs(c - d)", "abs(a - b) > 1e9"),
    "the way back along the edge": ("cpu", "_to_corners", "share if n == 2", "share if n == 1"),
    "a slope that moves nothing": ("cpu", "_to_corners", "-= g * slope", "-= 0 * slope"),
    "the picture's other pixel": ("cpu", "_to_picture", "(y, x) if s > 0", "(y, x) if s < 0"),
    "one triangle is not followed on the gpu": ("gpu", "_follow", "(beyond < 0)", "(beyond < 1000000)"),
    "an edge for another": (
        "gpu",
        "_follow",
        "least == p, 0, tl.where(least == q, 1, 2)",
        "least == p, 1, tl.where(least == q, 0, 2)",
    ),
    "the sign of a change": ("gpu", "_backward", "-s[:, None] * g", "s[:, None] * g"),
    "ends mistaken": ("gpu", "_backward", "i, a, to_s * (1 - share)", "i, a, to_s * share"),
    "depth of an end": ("gpu", "_move", "(along - slope * across)", "along"),
}

ASTRAY = {"a neighbour beyond the picture": ("cpu", "_find", "column + dx >= width or", "")}
