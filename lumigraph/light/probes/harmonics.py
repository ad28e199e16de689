"""Spherical harmonics of radiance, and of irradiance (Ramamoorthi 2001)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from ... import kernels

# A_l of the clamped cosine, for bands 0 to 3 (eq. 8): odd bands beyond the first add nothing.
COSINE_FACTORS = math.pi, 2 * math.pi / 3, math.pi / 4, 0.0
MAX_ORDER = len(COSINE_FACTORS) - 1

Coefficients = Float[Tensor, "*probe coefficient 3"]


def projected(
    directions: Float[Tensor, "ray 3"], light: Float[Tensor, "*probe ray 3"], angles: Float[Tensor, " ray"], order: int
) -> Coefficients:
    """Coefficients L_lm = sum L(w) Y_lm(w) dw up to a band, in the order l (l + 1) + m.

    angles: solid angle of each direction; they are scaled to 4 pi together
    """
    basis = kernels.spherical_harmonics(directions, order + 1)
    shares = 4 * math.pi * angles / angles.sum()
    return torch.einsum("rk,...rc->...kc", shares[:, None] * basis, light)


def convolved(radiance: Coefficients) -> Coefficients:
    """Coefficients of irradiance: E_lm = A_l L_lm (eq. 9)."""
    order = math.isqrt(radiance.shape[-2]) - 1
    factors = [COSINE_FACTORS[band] for band in range(order + 1) for _ in range(2 * band + 1)]
    return radiance * radiance.new_tensor(factors)[:, None]


def evaluated(coefficients: Float[Tensor, "#row coefficient 3"], directions: Float[Tensor, "row 3"]) -> Tensor:
    """Sum of coefficients times harmonics for each row: its value along its direction. Negative values become 0."""
    basis = kernels.spherical_harmonics(directions, math.isqrt(coefficients.shape[-2]))
    return (basis[..., None] * coefficients).sum(-2).clamp_min(0)
