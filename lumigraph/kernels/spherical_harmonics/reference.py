"""Reference implementation: K_lm q_lm(z) times the real or imaginary part of (x + i y)^|m| (Sloan 2013)."""

import torch
from torch import Tensor

from . import K00, K1, K20, K21, K22, K30, K31, K32, K33


def run(directions: Tensor, bands: int) -> Tensor:
    x, y, z = directions.unbind(-1)
    polynomials = [
        K00 + 0 * x,
        -K1 * y,
        K1 * z,
        -K1 * x,
        K21 * x * y,
        -K21 * y * z,
        K20 * (3 * z**2 - 1),
        -K21 * x * z,
        K22 * (x**2 - y**2),
        -K33 * y * (3 * x**2 - y**2),
        2 * K32 * x * y * z,
        -K31 * y * (5 * z**2 - 1),
        K30 * z * (5 * z**2 - 3),
        -K31 * x * (5 * z**2 - 1),
        K32 * z * (x**2 - y**2),
        -K33 * x * (x**2 - 3 * y**2),
    ]
    return torch.stack(polynomials[: bands**2], -1)
