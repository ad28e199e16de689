"""Even samples along each ray, all of one pass (Li 2021, section 4)."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ...camera.rays import Rays, Samples
from ...components.fields.spaces import Space
from ...components.sampling.sampling import stratified
from ...files.ranges import BatchSize, RaySamples
from ...method import Field, Pass, Sampler
from ...method.sampler import RayCodes, codes_at


@dataclass(frozen=True)
class EvenNumbers:
    """A Config's numbers of rays of the paper's networks (section 4)."""

    samples: RaySamples = 128  # samples of a ray; more find thinner things, slower
    rays_per_step: BatchSize = 1024  # rays of a step; more reduce noise, and cost memory and time

    @property
    def samples_per_step(self) -> int:
        """Number of samples of all rays."""
        return self.samples * self.rays_per_step


class EvenSampler(Sampler):
    """A fixed number of samples of each ray, linear in the coordinates of a space."""

    rays_per_chunk = 1024

    def __init__(self, space: Space, numbers: EvenNumbers):
        super().__init__()
        self.space, self.samples = space, numbers.samples
        self.batch_size = self.expected_rays = numbers.rays_per_step

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
