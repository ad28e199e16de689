"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "transmittance forgotten": ("cpu", "_sample", "passed *= left", "passed *= one"),
    "weight of the uniform part forgotten": ("cpu", "_sample", "below += found[i] + least", "below += found[i]"),
    "grid looked up at a bin's start": ("cpu", "_look_up", "0.5) * (edges[i] + edges[i + 1])", "1) * edges[i]"),
    "the far corners of another plane": ("cpu", "_interpolated", "high = (values[plane]", "high = (values[at]"),
    "frustum's stretch as far as near": ("cpu", "_look_up", "inverse * cube_root(inverse)", "inverse"),
    "bin in its own shadow": ("gpu", "_sample", "tl.exp(tau - tl.cumsum(tau, 0))", "tl.exp(-tl.cumsum(tau, 0))"),
    "not annealed": ("gpu", "_sample", "tl.exp2(sharpness * tl.log2(", "tl.exp2(1.0 * tl.log2("),
    "edges of the first block again": ("gpu", "_sample", "share = whole * (j.", "share = whole * ((j - j0)."),
    "corner forgotten": ("gpu", "_interpolated", "tl.static_range(8)", "tl.static_range(7)"),
    "disparity everywhere": ("gpu", "_distance", "tl.where(s < 1, s, ", "tl.where(s < 0, s, "),
    "not clamped at the near plane": ("gpu", "_sample", "1 / tl.maximum(z, plane)", "1 / tl.maximum(z, 0.01)"),
}

ASTRAY = {
    "the coordinate 1, a cell too far": ("cpu", "_cell", "np.int32(size - 2)", "np.int32(size - 1)"),
    "an edge too many": ("cpu", "_sample", "range(count + 1)", "range(count + 2)"),
}
