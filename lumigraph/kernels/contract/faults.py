"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "a ball of radius 2": ("cpu", "scale_of", "np.float32(0.5) * (one", "np.float32(1) * (one"),
    "contracted inside the unit ball too": ("cpu", "scale_of", " if radius > one else one", ""),
    "two directions of the Jacobian": ("cpu", "_stretch", "across * across", "across"),
    "Newton's method ends early": ("cpu", "cube_root", "range(3)", "range(1)"),
    "radius of a plane": ("gpu", "scale_of", " + z * z", ""),
    "coordinate of another axis": ("gpu", "_contract", "across * x, across * y", "across * x, across * x"),
    "square root for the cube root": ("gpu", "stretch_of", ") / 3)", ") / 2)"),
}

ASTRAY = {"a fourth axis": ("cpu", "_contract", "range(3)", "range(4)")}
