"""Even samples along each ray, all of one pass (Li 2021, section 4)."""

from __future__ import annotations

import torch

from ...camera.rays import Rays, Samples
from ...components.sampling.sampling import stratified
from ...components.sampling.spaces import Space
from ...method import Field, Pass, Sampler
from ...method.sampler import RayCodes, codes_at


class EvenSampler(Sampler):
    """A fixed number of samples of each ray, linear in the coordinates of a space."""

    rays_per_chunk = 1024

    def __init__(self, space: Space, samples: int, rays_per_step: int):
        super().__init__()
        self.space, self.samples = space, samples
        self.batch_size = self.expected_rays = rays_per_step

    def sample(
        self, rays: Rays, field: Field, code: RayCodes | None = None, generator: torch.Generator | None = None
    ) -> list[Pass]:
        near, far = self.space.interval(rays)
        shares = stratified(len(rays), self.samples, generator, rays.origins.device)
        samples = Samples.rows(self.space.distance(shares, rays, near, far), far)
        points, directions = samples.along(rays)
        density, features = field.geometry(points, None if code is None else codes_at(samples.ray_index, code))
        if generator is not None:
            self.evaluated = len(samples)
        return [Pass("samples", samples, density, features, directions, evaluated=len(samples))]
