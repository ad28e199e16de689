"""Hierarchical sampler: uniform samples along each ray, then importance sampling (Mildenhall 2020, 5.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...camera.rays import Rays, Samples
from ...files.ranges import BatchSize, RaySamples
from ...method import Pass, Sampler
from ...method.sampler import RayCodes, codes_at
from ...volume import weights_of
from ..fields.coordinate_field import Places
from ..fields.spaces import Space
from .occupancy import MaskNumbers, OccupancyMask
from .sampling import inverse_transform, midpoints, stratified

RESAMPLE_PADDING = 0.01  # alpha, least weight of a frustum of a cone (Barron 2021, eq. 17)
RAYS_WITH_FEATURES = 1024  # rays that are rendered at once where the features of all their samples are kept


@dataclass(frozen=True)
class RayNumbers:
    """A Config's numbers of rays and of the samples of their two passes; the paper's (Mildenhall 2020)."""

    coarse_samples: RaySamples = 64  # coarse samples of a ray, appendix A; more find thinner things, slower
    fine_samples: RaySamples = 128  # fine samples of a ray, by the coarse weights, appendix A; more are sharper
    rays_per_step: BatchSize = 4096  # rays in a step, section 5.3; more reduce noise, and cost memory and time

    @property
    def samples_per_step(self) -> int:
        """Number of samples of both passes."""
        return self.rays_per_step * (self.coarse_samples + self.fine_samples)


# A Config's numbers for a plain CPU, and for tests.
CPU_NETWORK: dict[str, Any] = {"rays": RayNumbers(32, 16, rays_per_step=1024), "mask": MaskNumbers(128)}
CPU_NETWORK |= {"hidden_width": 128, "learning_rate": 4e-3, "final_learning_rate": 2e-4, "warmup": 0.02}
CPU_NETWORK |= {"coarse_loss_weight": 0.0}
TINY_NETWORK: dict[str, Any] = {"rays": RayNumbers(16, 12, rays_per_step=192), "mask": MaskNumbers(16)}
TINY_NETWORK |= {"hidden_width": 32, "learning_rate": 5e-3, "final_learning_rate": 5e-4, "warmup": 0.1}


class HierarchicalSampler(Sampler):
    """Two passes of a `CoordinateField`: a coarse one, and a fine one of the coarse samples and more.

    mask:                    of empty space, where the field is not evaluated
    learns_coarse:           whether colours of the coarse pass are learnt from; otherwise it only guides the fine pass
    transmittance_threshold: at which a ray terminates, by the coarse pass; 0: never
    rays_per_chunk:          rays that are rendered at once
    """

    def __init__(
        self,
        space: Space,
        numbers: RayNumbers,
        mask: MaskNumbers = MaskNumbers(),
        learns_coarse: bool = True,
        transmittance_threshold: float = 0.0,
        rays_per_chunk: int = Sampler.rays_per_chunk,
    ):
        super().__init__()
        self.rays_per_chunk = rays_per_chunk
        self.space, self.numbers, self.learns_coarse = space, numbers, learns_coarse
        self.transmittance_threshold = transmittance_threshold
        self.batch_size = self.expected_rays = numbers.rays_per_step
        self.empty = OccupancyMask(mask.occupancy_resolution)

    def sample(
        self, rays: Rays, field: Any, code: RayCodes | None = None, generator: torch.Generator | None = None
    ) -> list[Pass]:
        learns = generator is not None and self.learns_coarse
        shares = self.coarse_shares(rays, generator)
        with torch.set_grad_enabled(torch.is_grad_enabled() and learns):
            coarse = self._pass("coarse", field.coarse or field, rays, code, shares, None, generator, colours=learns)
            weights = weights_of(coarse.samples, coarse.density).view(len(rays), -1).detach()
        fine = self._pass("fine", field, rays, code, *self.fine_shares(shares, weights, generator), generator)
        if generator is not None:
            self.evaluated = fine.evaluated
        return [coarse, fine]

    def coarse_shares(self, rays: Rays, generator: torch.Generator | None) -> Float[Tensor, "ray place"]:
        """Sample positions of the first pass, from 0 to 1 along each ray."""
        return stratified(len(rays), self.numbers.coarse_samples, generator, rays.origins.device)

    def fine_shares(
        self, shares: Tensor, weights: Float[Tensor, "ray sample"], generator: torch.Generator | None
    ) -> tuple[Tensor, Bool[Tensor, " all_samples"] | None]:
        """Sample positions of the second pass, and a mask of those before termination; None for all."""
        again = stratified(len(shares), self.numbers.fine_samples, generator, shares.device)
        again = inverse_transform(midpoints(shares), weights[:, 1:-1], again)
        both, order = torch.cat([shares, again], -1).sort(-1)
        if not self.transmittance_threshold:
            return both, None
        lit = weights.cumsum(-1) - weights <= 1 - self.transmittance_threshold
        lit = torch.cat([lit, torch.ones_like(again, dtype=torch.bool)], -1)
        return both, lit.gather(-1, order).flatten()

    def places(self, shares: Tensor, rays: Rays) -> tuple[Samples, Places, Tensor | None]:
        """Samples from each position to the next (eq. 3), their input of the field, and their radius."""
        with torch.no_grad():  # the places of samples depend on no pose
            near, far = self.space.interval(rays)
            t = self.space.distance(shares, rays, near, far)
        points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
        return Samples.rows(t, far), (self.space.warp(points.flatten(0, 1)),), None

    def _pass(
        self,
        name: str,
        field: Any,
        rays: Rays,
        code: RayCodes | None,
        shares: Tensor,
        lit: Bool[Tensor, " all_samples"] | None = None,
        generator: torch.Generator | None = None,
        colours: bool = True,
    ) -> Pass:
        """Pass of a field at positions along rays. colours: evaluate them at once, for a field without a code"""
        samples, places, radius = self.places(shares, rays)
        if field.deforms:
            points, directions = samples.along(rays)
            density, features = field.geometry(points, None if code is None else codes_at(samples.ray_index, code))
            return Pass(name, samples, density, features, directions, None, None, len(samples), field=field)
        ray, features, rgb = samples.ray_index, places, None
        there = self.empty.may_hold(places[0], radius)
        where = there if lit is None else lit if there is None else lit & there
        if not field.joint:
            density, feature = field.features_at(*places)
            features = feature, field.encode_direction(rays.directions)[ray]
        elif colours:
            density, rgb = field.colours_at(places, ray, rays.directions, where, generator)
        else:
            density = field.density_at(*places, where=where, generator=generator)
        density = density * self.space.along(rays, samples)
        count = len(samples) if where is None else int(where.sum())
        return Pass(name, samples, density, features, rays.directions[ray], None, rgb, count, field=field)

    def begin_from(self, teacher: Any, chance: torch.Generator) -> None:
        self.empty.begin_from(teacher, self.space, chance)
