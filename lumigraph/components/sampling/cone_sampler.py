"""Cone sampler: conical frustums uniformly along each ray, then by importance sampling (Barron 2021, section 3.2)."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import max_pool1d, pad

from ...camera.rays import Rays, Samples
from ..fields.coordinate_field import Places
from ..fields.spaces import Space
from .hierarchical_sampler import RESAMPLE_PADDING, HierarchicalSampler
from .sampling import inverse_transform, stratified


class ConeSampler(HierarchicalSampler):
    """Two passes of a `FrustumField`. Positions along rays are edges of frustums; the second pass has its own.

    sampled_share: share of each ray, around `sampled_from`, that is sampled in training (Niemeyer 2022, eq. 10)
    sampled_from:  share of the way along each ray
    """

    def __init__(self, *arguments: Any, **named: Any):
        super().__init__(*arguments, **named)
        self.sampled_share, self.sampled_from = 1.0, 0.5

    def coarse_shares(self, rays: Rays, generator: torch.Generator | None) -> Float[Tensor, "ray edge"]:
        count = self.numbers.coarse_samples
        between = (0.5 + (count - 1) * stratified(len(rays), count - 1, generator, rays.origins.device)) / count
        edges = pad(pad(between, (1, 0)), (0, 1), value=1.0)
        return edges if generator is None else self.sampled_from + self.sampled_share * (edges - self.sampled_from)

    def fine_shares(
        self, shares: Float[Tensor, "ray edge"], weights: Float[Tensor, "ray bin"], generator: torch.Generator | None
    ) -> tuple[Float[Tensor, "ray fine_edge"], None]:
        again = stratified(len(shares), self.numbers.fine_samples + 1, generator, shares.device)
        return inverse_transform(shares, blurred(weights) + RESAMPLE_PADDING, again), None

    def places(self, shares: Float[Tensor, "ray edge"], rays: Rays) -> tuple[Samples, Places, Float[Tensor, " sample"]]:
        samples, means, variances = frustums_between(shares, rays, self.space)
        return samples, (means, variances), variances.amax(-1).sqrt()


def frustum_moments(
    start: Float[Tensor, "*n"], end: Float[Tensor, "*n"], radius: Float[Tensor, "*n"]
) -> tuple[Float[Tensor, "*n"], Float[Tensor, "*n"], Float[Tensor, "*n"]]:
    """Mean distance, variance along the axis, variance across it of a uniformly filled conical frustum.

    start, end: distances from the apex
    radius:     of the cone at distance one
    Barron 2021, eq. 7, in terms of the middle and the half-length: the direct form, differences of high powers of start
    and end, loses all digits for a thin frustum.
    """
    middle, half = 0.5 * (start + end), 0.5 * (end - start)
    both = (3 * middle.square() + half.square()).clamp_min(torch.finfo(middle.dtype).tiny)
    mean = middle + 2 * middle * half.square() / both
    along = half.square() / 3 - 4 / 15 * half**4 * (12 * middle.square() - half.square()) / both.square()
    across = radius.square() * (middle.square() / 4 + 5 / 12 * half.square() - 4 / 15 * half**4 / both)
    return mean, along.clamp_min(0), across.clamp_min(0)


def frustums_between(
    edges: Float[Tensor, "ray edge"], rays: Rays, space: Space
) -> tuple[Samples, Float[Tensor, "sample 3"], Float[Tensor, "sample 3"]]:
    """Frustums between edges, given as positions from 0 to 1 along each ray, and their means and variances in a
    space."""
    with torch.no_grad():  # where samples lie tells nothing of a pose
        near, far = space.interval(rays)
        t = space.distance(edges, rays, near, far)
    samples = Samples.rows(t[:, :-1], t[:, -1])
    ray = samples.ray_index
    distance, along, across = frustum_moments(samples.t_start, samples.t_end, rays.radius[ray])
    directions = rays.directions[ray]
    points = rays.origins[ray] + distance[:, None] * directions
    return samples, *space.warp_gaussians(points, directions, along, across)


def blurred(weights: Float[Tensor, "ray bin"]) -> Float[Tensor, "ray bin"]:
    """Blurred weights, so that the fine samples surround the coarse ones of high weight (Barron 2021, eq. 17)."""
    larger = max_pool1d(pad(weights, (1, 1)), 2, 1)  # of each two neighbours
    return 0.5 * (larger[:, 1:] + larger[:, :-1])
