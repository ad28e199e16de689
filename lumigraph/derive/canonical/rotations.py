"""Rotations evenly spread, and how far rotations are apart."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from ...geometry import to_matrix

PHI, PSI = math.sqrt(2.0), 1.533751168755204288118041  # psi^4 = psi + 4


def spread(count: int) -> Float[Tensor, "rotation 3 3"]:
    """Rotations all over SO(3), about equally far from their neighbours: super-Fibonacci spirals (Alexa 2022)."""
    s = torch.arange(count, dtype=torch.float64) + 0.5
    t = s / count
    inner, outer = t.sqrt(), (1 - t).sqrt()
    alpha, beta = 2 * math.pi * s / PHI, 2 * math.pi * s / PSI
    return to_matrix(torch.stack([inner * alpha.sin(), inner * alpha.cos(), outer * beta.sin(), outer * beta.cos()], 1))


def near(degrees: float) -> Float[Tensor, "rotation 3 3"]:
    """The identity, and rotations by an angle about the 26 directions to the neighbours of a cube among cubes."""
    steps = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    axes = torch.nn.functional.normalize(torch.cartesian_prod(steps, steps, steps), dim=-1)
    half = 0.5 * math.radians(degrees)
    return to_matrix(torch.cat([torch.full((27, 1), math.cos(half), dtype=torch.float64), math.sin(half) * axes], 1))


def random(count: int, generator: torch.Generator) -> Float[Tensor, "rotation 3 3"]:
    """Rotations, all equally likely."""
    return to_matrix(torch.randn(count, 4, generator=generator, dtype=torch.float64))


def nearest_rotation(matrices: Float[Tensor, "*matrix 3 3"]) -> Float[Tensor, "*matrix 3 3"]:
    """The rotation nearest to each matrix in the sense of least squares (Kabsch 1976): U diag(1, 1, +-1) V^T."""
    u, _, vt = torch.linalg.svd(matrices)
    sign = torch.linalg.det(u @ vt)
    return torch.cat([u[..., :2], u[..., 2:] * sign[..., None, None]], -1) @ vt
