"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "a leap too far": ("cpu", "onward", "np.int64(-1 - row)", "np.int64(-row)"),
    "what lies behind is not hidden": ("cpu", "_value_gradients", "(g_distance[r] * t - hidden)", "g_distance[r] * t"),
    "hidden by all but itself": ("cpu", "_value_gradients", "(ONE - v[A]) * hidden", "hidden"),
    "gradient of another step": ("cpu", "_spread", "d_v[s, c]", "d_v[j, c]"),
    "empty voxels as the first row": ("cpu", "corners", "count += row >= 0", "count += 1"),
    "a step as long as a straight one": ("cpu", "later", "if radius <= ball", "if True"),
    "what is far is left where it is": ("cpu", "placed", "(TWO - share)", "TWO"),
    "gradient of a place contracted too far": ("cpu", "_value_gradients", "t, ball)", "t, ball / 2)"),
    "steps that do not shorten sideways": ("gpu", "_later", "4 * aside", "0 * aside"),
    "gradient of the place without contraction there": ("gpu", "_backward", "ball, CURVED)", "ball, False)"),
    "an apron too many": ("gpu", "_cell_of", "+ 1.0", "+ 2.0"),
    "light behind its own alpha": ("gpu", "_march", "transmittance *= 1 - alpha", "transmittance *= alpha"),
    "weight forgotten": ("gpu", "_backward", "weight[:, None] * d_v", "d_v"),
    "what lies behind is not hidden there": ("gpu", "_backward", "g_along * t - hidden", "g_along * t"),
}

ASTRAY = {"the block beyond the grid": ("cpu", "block_of", "ix < index.shape[0]", "ix <= index.shape[0]")}
