"""Cone sampler: frustums of cones evenly along each ray, then where those found density (Barron 2021, section 3.2)."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from ...camera.rays import Rays, Samples
from ..fields.coordinate_field import Places
from .frustums import blurred, frustums_between
from .hierarchical_sampler import HierarchicalSampler
from .sampling import inverse_transform, stratified


class ConeSampler(HierarchicalSampler):
    """Two passes of a `FrustumField`. Places along rays are edges of frustums; the second pass has its own.

    resample_padding: weight that every frustum has at least (alpha of eq. 17)
    sampled_share:    share of each ray, around its middle, that is sampled in training (Niemeyer 2022, eq. 10)
    """

    def __init__(self, *arguments: Any, resample_padding: float = 0.01, **named: Any):
        super().__init__(*arguments, **named)
        self.resample_padding, self.sampled_share = resample_padding, 1.0

    def coarse_shares(self, rays: Rays, generator: torch.Generator | None) -> Float[Tensor, "ray edge"]:
        count = self.numbers.coarse_samples
        between = (0.5 + (count - 1) * stratified(len(rays), count - 1, generator, rays.origins.device)) / count
        edges = pad(pad(between, (1, 0)), (0, 1), value=1.0)
        return edges if generator is None else 0.5 + self.sampled_share * (edges - 0.5)

    def fine_shares(
        self, shares: Float[Tensor, "ray edge"], weights: Float[Tensor, "ray bin"], generator: torch.Generator | None
    ) -> tuple[Float[Tensor, "ray fine_edge"], None]:
        again = stratified(len(shares), self.numbers.fine_samples + 1, generator, shares.device)
        return inverse_transform(shares, blurred(weights) + self.resample_padding, again), None

    def places(self, shares: Float[Tensor, "ray edge"], rays: Rays) -> tuple[Samples, Places, Float[Tensor, " sample"]]:
        samples, means, variances = frustums_between(shares, rays, self.space)
        return samples, (means, variances), variances.amax(-1).sqrt()
