"""Samples along rays: evenly, then where these found density; with a measured depth, around that instead."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...camera.rays import Rays, Samples
from ...components.sampling.sampling import inverse_transform, midpoints, stratified
from ...components.sampling.spaces import Box
from ...files.ranges import RaySamples
from ...method import Pass, Sampler
from ...volume import weights_of

MIN_WEIGHT = 1e-4  # of a sample in a picture, below which it gets no colour
BANDS_PER_STEP = 1.5  # half-widths of the band between coarse samples where depth is unknown
MIN_INTERVAL = 1e-3  # scene units of a ray that misses the box


@dataclass(frozen=True)
class RayNumbers:
    """A Config's numbers of samples along a ray (Sucar 2021, section 3.2)."""

    coarse_samples: RaySamples = 32  # N_c, stratified samples of a ray; more find thinner things, slower
    fine_samples: RaySamples = 12  # N_f, further samples of a ray where density is; more are sharper, slower


class MapSampler(Sampler):
    """Coarse and fine samples of one field; both are composited.

    band: half-width in scene units around a measured depth that fine samples lie in, and coarse ones end behind; None
          for fine samples by the coarse weights alone
    """

    rays_per_chunk = 4096

    def __init__(self, space: Box, numbers: RayNumbers, band: float | None):
        super().__init__()
        self.space, self.numbers, self.band = space, numbers, band
        self.batch_size, self.expected_rays, self.unguided_samples = 1, 1.0, numbers.coarse_samples
        if band is not None:  # a surface is not stepped over
            longest = math.dist(*space.bounds)
            self.unguided_samples = max(numbers.coarse_samples, math.ceil(longest / (BANDS_PER_STEP * band)))

    def sample(
        self,
        rays: Rays,
        field: Any,
        code: Tensor | None = None,
        generator: torch.Generator | None = None,
        depth: Float[Tensor, " ray"] | None = None,
    ) -> list[Pass]:
        """depth: measured distances, NaN where none is; None without any"""
        with torch.no_grad():
            samples = self.placed(rays, field, generator, depth)
        positions, directions = samples.along(rays)
        density, features = field.geometry(positions)
        if torch.is_grad_enabled():
            return [Pass("fine", samples, density, features, directions, evaluated=len(samples))]
        there = (weights_of(samples, density) > MIN_WEIGHT).nonzero()[:, 0]
        seen = features[there], directions[there], there
        return [Pass("fine", samples, density, *seen, evaluated=len(samples))]

    def placed(
        self, rays: Rays, field: Any, generator: torch.Generator | None, depth: Float[Tensor, " ray"] | None
    ) -> Samples:
        n, device = self.numbers, rays.origins.device
        near, far = self.space.interval(rays)
        far = torch.maximum(far, near + MIN_INTERVAL)
        ends = far
        guided = self.band is not None and depth is not None
        if guided:
            assert depth is not None and self.band is not None
            known = depth.isfinite()
            ends = torch.where(known, torch.minimum(depth + self.band, far), far)
            ends = torch.maximum(ends, near + MIN_INTERVAL)
        count = n.coarse_samples if guided else self.unguided_samples
        shares = stratified(len(rays), count, generator, device)
        coarse = torch.lerp(near[:, None], ends[:, None], shares)
        again = stratified(len(rays), n.fine_samples, generator, device)
        if guided:
            middle = torch.where(known, depth, 0.5 * (near + ends))
            half = torch.where(known, self.band, 0.5 * (ends - near))
            fine = middle[:, None] + half[:, None] * (2 * again - 1)
        else:
            first = Samples.rows(coarse, ends)
            density = field.density(first.along(rays)[0])
            weights = weights_of(first, density).view(len(rays), -1)
            fine = inverse_transform(midpoints(coarse), weights[:, 1:-1], again)
        t = torch.cat([coarse, fine], -1).maximum(near[:, None]).minimum(ends[:, None]).sort(-1).values
        return Samples.rows(t, ends)
