"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "a row of pixels lower": ("cpu", "_draw", "y = row + 0.5", "y = row + 1.5"),
    "the farthest": ("cpu", "_draw", "buffer[row - top, column] < w", "0 == buffer[row - top, column]"),
    "barycentric coordinates of the screen": ("cpu", "_barycentric", "u * z, v * z, w * z", "u, v, w"),
    "a slope that leaves out the mean": ("cpu", "_sum_up", "(slope[0, m] - mean)", "slope[0, m]"),
    "depth's own slope forgotten": ("cpu", "_sum_up", "own[1, 2] += far", "own[1, 2] += 0"),
    "hidden triangles too": ("cpu", "_backward", "if found[row, column] == f:", "if found[row, column] >= 0:"),
    "an edge without an outside": ("gpu", "_draw", "tl.minimum(tl.minimum(u, v), w) >=", "tl.minimum(u, v) >="),
    "a column of the box left out": ("gpu", "_range", "- first + 1", "- first"),
    "a mean that is not taken off": ("gpu", "_backward", "g, h, q = g - mean", "g, h, q = g"),
    "depth moves no corner": ("gpu", "_pull", "far * share - share", "0 - share"),
    "attributes of the first corner": ("gpu", "_backward", "d_attributes + m[:, None]", "d_attributes + i[:, None]"),
    "one corner's sums": ("cpu", "_gather", "vertex = faces[f, i]", "vertex = faces[f, 0]"),
}

ASTRAY = {"a box beyond the picture": ("cpu", "_pixels", "size - 1.0", "size + 1.0")}
