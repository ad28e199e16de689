"""Samples along rays: evenly, then where these found density; with a measured depth, around that instead."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...camera.rays import Rays, Samples
from ...components.fields.spaces import Box
from ...components.sampling.sampling import inverse_transform, midpoints, stratified
from ...files.ranges import RaySamples
from ...method import Pass, Sampler
from ...volume import weights_of

MIN_WEIGHT = 1e-4  # of a sample in a picture, below which it gets no colour
BANDS_PER_STEP = 1.5  # half-widths of the band between coarse samples where depth is unknown
MIN_INTERVAL = 1e-3  # scene units of a ray that misses the box


@dataclass(frozen=True)
class SampleNumbers:
    """A Config's numbers of samples along a ray (Sucar 2021, section 3.2)."""

    coarse_samples: RaySamples = 32  # N_c, stratified samples of a ray; more find thinner things, slower
    fine_samples: RaySamples = 12  # N_f, further samples of a ray where density is; more are sharper, slower


class MapSampler(Sampler):
    """Coarse and fine samples of one field; both are composited.

    band: half-width in scene units around a measured depth that fine samples lie in, and coarse ones end behind; None
          for fine samples by the coarse weights alone
    """

    rays_per_chunk = 4096

    def __init__(self, space: Box, numbers: SampleNumbers, band: float | None):
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
        ends = torch.maximum(far, near + MIN_INTERVAL)
        again = stratified(len(rays), n.fine_samples, generator, device)
        if self.band is None or depth is None:
            coarse = self._evenly(near, ends, self.unguided_samples, generator)
            first = Samples.rows(coarse, ends)
            weights = weights_of(first, field.density(first.along(rays)[0])).view(len(rays), -1)
            fine = inverse_transform(midpoints(coarse), weights[:, 1:-1], again)
        else:
            known = depth.isfinite()
            ends = torch.where(known, (depth + self.band).minimum(ends).maximum(near + MIN_INTERVAL), ends)
            coarse = self._evenly(near, ends, n.coarse_samples, generator)
            start, last = (torch.where(known, depth + x, y) for x, y in ((-self.band, near), (self.band, ends)))
            fine = torch.lerp(start[:, None], last[:, None], again)
        t = torch.cat([coarse, fine], -1).maximum(near[:, None]).minimum(ends[:, None]).sort(-1).values
        return Samples.rows(t, ends)

    def _evenly(self, near: Tensor, ends: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
        return torch.lerp(near[:, None], ends[:, None], stratified(len(near), count, generator, near.device))
