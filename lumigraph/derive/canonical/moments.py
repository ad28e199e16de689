"""A shape as functions on spheres: how much of it lies in each direction, at several distances from its middle."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from .harmonics import harmonics

MAX_RADIUS = 2.2  # spreads from the mean; hardly anything lies beyond


def shells(distances: Float[Tensor, "*point"], count: int) -> Float[Tensor, "*point shell"]:
    """Weight of each point in each shell: bells about equidistant radii from 0 to MAX_RADIUS."""
    step = MAX_RADIUS / (count - 1)
    radii = step * torch.arange(count, dtype=distances.dtype, device=distances.device)
    return (-0.5 * ((distances[..., None] - radii) / (0.7 * step)).square()).exp()


def directions_and_distances(
    points: Float[Tensor, "*point 3"],
) -> tuple[Float[Tensor, "*point 3"], Float[Tensor, "*point"]]:
    distances = points.norm(dim=-1)
    return points / distances.clamp_min(1e-9)[..., None], distances


def moments(
    points: Float[Tensor, "*some point 3"], weights: Float[Tensor, "*some point"], count: int, bands: int
) -> Float[Tensor, "*some shell basis"]:
    """Integrals of a density times each shell times each harmonic: f = sum_i w_i s(|x_i|) Y(x_i / |x_i|).

    Turned with the points: moments(R x) are D(R) moments(x), to rounding.
    """
    directions, distances = directions_and_distances(points)
    parts = weights[..., None] * shells(distances, count)
    return parts.mT @ harmonics(directions, bands)
