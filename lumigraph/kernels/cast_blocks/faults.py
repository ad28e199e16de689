"""Faults that tests seed, by name: engine, function, code, replacement. ASTRAY: out-of-bounds accesses."""

FAULTS = {
    "blocks skipped too far": ("cpu", "_cast_one", "stride = leave / step - EARLY", "stride = leave / step + ONE"),
    "surfaces from behind": ("cpu", "_cast_one", "distance < ZERO and before >= ZERO", "distance < ZERO"),
    "the block's own neighbour": ("cpu", "_gather", "(z >> 3) + (e >> 3)", "(z >> 3)"),
    "unknown voxels count": ("cpu", "_all_known", "w[7] > ZERO", "w[7] >= ZERO"),
    "the middle of a step": ("cpu", "_cast_one", "step * before / (before - distance)", "step / (ONE + ONE)"),
    "colours without one": ("gpu", "_cast", "mask=painted, other=-1.0) >= 0)", "mask=painted, other=-1.0) >= -2)"),
    "a normal's sign": ("gpu", "_cast", "gy += d * (2 * (c // 2 % 2) - 1)", "gy -= d * (2 * (c // 2 % 2) - 1)"),
    "surfaces from behind, on the gpu": ("gpu", "_cast", "(distance < 0) & (before >= 0)", "(distance < 0)"),
    "blocks skipped too far, on the gpu": ("gpu", "_cast", "leave / step - 0.02", "leave / step + 1"),
}

ASTRAY = {"another block's end": ("cpu", "_gather", "row = (((a & 7) << 6)", "row = ((a << 6)")}
