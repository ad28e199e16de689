"""A hash table for photographs in other light: colours of the field of Müller 2022 depend on a code of each as well."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ... import kernels
from ...camera.rays import Rays
from ...datasets.scene import Frame, Scene
from ..sampling.coarse_to_fine import first_grid, keep_looking, lattice, stage
from ..sampling.marching import FIRST_RAYS, rays_for, reached
from ..sampling.proposal import Proposed
from ..sampling.spaces import space_of
from ..sampling.unbounded import RAYS, rays_of, unbounded
from ..training.fog import scaled_by_distance
from ..training.lazy_adam import LazyAdam
from .coded_field import CodedField, Places
from .hash_field import CALM, HashField, side_by_side
from .mlp import MLP

CODES_RATE = 0.25  # of the networks' learning rate, that codes beside a hash table learn at

Joining = Callable[[int], Tensor | None]  # the weights of so many levels or octaves; None where all count fully


class CodedHash(CodedField):
    """A hash table and small networks, marched through an occupancy grid as Instant-NGP does.

    code:    numbers that colour depends on beside place and direction
    joining: how much each level counts, while poses are refined coarse to fine
    """

    rays_per_chunk = 16_384
    rays_per_step: Tensor

    def __init__(self, frame: Frame, config: Any, code: int, joining: Joining | None = None):
        super().__init__()
        self.config, self.frame, self.joining = config, frame, joining
        self.space = space_of(frame)
        self.unbounded = unbounded(frame, self.space, config)
        if self.unbounded:
            self.rays_per_chunk = RAYS
        self.scene = HashField(config, self.space, frame.reach, code)
        open_sky = config.own_skies and self.unbounded is not None and not frame.has_alpha
        self.sky = MLP(config.sh_bands**2 + code, config.hidden_width, 3) if open_sky else None
        self.occupancy = first_grid(config, frame.reach)
        self.lattice = lattice(config, frame.reach)
        first = rays_of(config.samples_per_step, config) if self.unbounded else FIRST_RAYS
        self.register_buffer("rays_per_step", torch.tensor(first))
        self._proposed: tuple[Proposed, Tensor]  # of the last look at a capture without a bound, with the density there

    @property
    def batch_size(self) -> int:
        return int(self.rays_per_step)

    def passes(self, rays: Rays, generator: torch.Generator | None = None) -> list[Places]:
        learning, device = generator is not None, rays.origins.device
        jitter = torch.rand(len(rays), 2, generator=generator).to(device) if learning else None
        if self.unbounded and not learning and not torch.is_grad_enabled():
            samples = self.unbounded.proposal.places(rays)
            asked = len(samples)
        elif self.unbounded:
            proposed = self.unbounded.proposal.sample(rays, jitter)
            samples, asked = proposed.samples, len(proposed.samples)
        else:
            moved = None if jitter is None else jitter[:, 0]
            found = self.occupancy.sample(rays, self.frame.near, *self.lattice, jitter=moved)
            samples, asked = reached(rays, found, self.density, self.config.transmittance_threshold)
        points, directions = samples.along(rays)
        encoded = self._encoded(points)
        density, geometry = self.scene.density(encoded)
        density = density * self.space.stretch(points)
        if self.unbounded and learning:
            density, geometry = scaled_by_distance(samples.t, density, geometry)
            self._proposed = proposed, density
        # The table is of what stays: a transient head may read it, and has no say in what it learns.
        unseen, stretch = encoded.detach(), torch.ones_like(density)
        return [Places("samples", samples, density, (geometry, directions), unseen, stretch, asked)]

    def further_terms(self, generator: torch.Generator) -> dict[str, Tensor]:
        return self.unbounded.terms(self.density, *self._proposed, generator) if self.unbounded else {}

    def begin(self, scene: Scene, seconds: float, generator: torch.Generator) -> None:
        if self.unbounded:
            self.unbounded.begin(scene, seconds, generator)

    def colour(self, places: Places, codes: Float[Tensor, "sample code"]) -> Float[Tensor, "sample 3"]:
        return self.scene.colour(*places.seen, codes)

    def behind(
        self, rays: Rays, codes: Float[Tensor, "ray code"], background: Float[Tensor, "#ray 3"]
    ) -> Float[Tensor, "#ray 3"]:
        """In the open a sky, which a direction and an appearance tell (as in Rematas 2022, beside the appearance).

        No two photographs agree on the weather, so that without it what passes would take the sky, and nothing stay.
        """
        if self.sky is None:
            return background
        harmonics = kernels.spherical_harmonics(rays.directions, self.config.sh_bands)
        return self.sky(side_by_side(harmonics, codes)).sigmoid()

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        return self.scene.density(self._encoded(points))[0] * self.space.stretch(points)

    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"], code: Float[Tensor, " code"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        density, geometry = self.scene.density(self._encoded(points))
        density = density * self.space.stretch(points)
        return density, self.scene.colour(geometry, directions, code.expand(len(points), -1))

    def _encoded(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point width"]:
        joining = self.joining(self.config.levels) if self.joining else None
        return self.scene.encode(self.space.warp(points), joining)

    def before_step(self, step: int, progress: float, generator: torch.Generator) -> None:
        if self.unbounded:
            self.unbounded.before_step(progress)
            return
        self.lattice = lattice(self.config, self.frame.reach, stage(progress).steps)
        keep_looking(self.occupancy, self.density, self.config, step, progress, generator)

    def after_step(self, samples: float) -> None:
        if not self.unbounded:
            self.rays_per_step.fill_(rays_for(self.config.samples_per_step, int(self.rays_per_step), samples))

    def optimizers(self, codes: list[nn.Parameter]) -> list[torch.optim.Optimizer]:
        common: dict[str, Any] = {"lr": self.config.learning_rate, "betas": (0.9, 0.99), "eps": 1e-15}
        own = "scene.table", "unbounded.proposal.grid.values"
        networks = [weight for name, weight in self.named_parameters() if name not in own]
        groups = [{"params": networks, "scale": CALM}, {"params": codes, "scale": CODES_RATE}]
        optimizers = [LazyAdam([self.scene.table], **common), torch.optim.Adam(groups, foreach=True, **common)]
        return [*optimizers, self.unbounded.optimizer()] if self.unbounded else optimizers
