"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "the wrong image": ("cpu", "_gradient", "other[x] * products", "own[x] * products"),
    "the variance's sign": ("cpu", "_likeness", "= -S * B1 * r", "= S * B1 * r"),
    "the other image's derivative": ("cpu", "backward", "MEAN_B if i and", "MEAN_A if i and"),
    "the loss's gradient forgotten": ("cpu", "backward", "grad.item() / a", "1 / a"),
    "the difference's sign": ("cpu", "_gradient", "+ step * sign", "- step * sign"),
    "a difference without its sign": ("cpu", "_gap", "abs(a[i] - b[i])", "a[i] - b[i]"),
    "a slope where both are alike": ("gpu", "_gradient", "tl.where(mine < its", "tl.where(mine <= its"),
    "a square's slope": ("gpu", "_gradient", "2 * mine", "mine"),
    "a slope's sign": ("gpu", "_likeness", "(B1 - B2)", "(B2 - B1)"),
    "the neighbouring channel": ("gpu", "_along", "(k - REACH) * C", "k - REACH"),
}

ASTRAY = {"a window too long": ("cpu", "_window", "x[at + 10 * step]", "x[at + 11 * step]")}
