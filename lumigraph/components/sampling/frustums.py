"""Cones: a pixel sees a cone, not a line, and a stretch of it is nearly a Gaussian (Barron et al. 2021)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def frustum_moments(
    start: Float[Tensor, "*n"], end: Float[Tensor, "*n"], radius: Float[Tensor, "*n"]
) -> tuple[Float[Tensor, "*n"], Float[Tensor, "*n"], Float[Tensor, "*n"]]:
    """Mean distance, variance along the axis, variance across it of a uniformly filled conical frustum.

    start, end: distances from the apex
    radius:     of the cone at distance one
    Barron 2021, eq. 7, in terms of the middle and the half-length: differences of high powers of start and end, as one
    would first write it, lose all their digits where the frustum is thin.
    """
    middle, half = 0.5 * (start + end), 0.5 * (end - start)
    both = (3 * middle.square() + half.square()).clamp_min(torch.finfo(middle.dtype).tiny)
    mean = middle + 2 * middle * half.square() / both
    along = half.square() / 3 - 4 / 15 * half**4 * (12 * middle.square() - half.square()) / both.square()
    across = radius.square() * (middle.square() / 4 + 5 / 12 * half.square() - 4 / 15 * half**4 / both)
    return mean, along.clamp_min(0), across.clamp_min(0)
