"""Leaf sampler: each leaf that a ray crosses is a sample, as long as the ray is in it."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ...camera.rays import Rays
from ...method import Pass, Sampler
from .leaves import Leaves


class LeafSampler(Sampler):
    """Samples at the leaves of an octree, from near to far until rays terminate.

    near:          distance from a camera at which its rays begin
    stop:          transmittance at which a ray terminates
    rays_per_step: rays of a step
    """

    rays_per_chunk = 1 << 18

    def __init__(self, near: float, stop: float, rays_per_step: int):
        super().__init__()
        self.near, self.stop = near, stop
        self.batch_size = self.expected_rays = rays_per_step

    def sample(  # type: ignore[override]
        self,
        rays: Rays,
        field: Leaves,
        code: Float[Tensor, "ray code"] | None = None,
        generator: torch.Generator | None = None,
    ) -> list[Pass]:
        found = field.crossed(rays, self.near, self.stop)
        density = field.densities[found.rows, 0].relu()
        directions = rays.directions[found.samples.ray_index]
        return [Pass("leaves", found.samples, density, field.harmonics[found.rows], directions)]
