"""Sampler: sample positions along rays for a field, and Pass, the result."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import embedding

from ..camera.rays import Look, Rays, Samples
from .field import Features, Field
from .part import Part

RayCodes = Float[Tensor, "ray code"]
Density = Callable[[Float[Tensor, "point 3"]], Float[Tensor, " point"]]


@dataclass(frozen=True)
class Pass:
    """Samples along rays with a field's geometry there; colours follow, with any code.

    density:    per scene unit
    features:   input of `Field.colour`, of the samples that get a colour
    directions: of the same samples
    coloured:   indices of the samples that get a colour; None for all
    rgb:        of a field that evaluates density and colour jointly
    evaluated:  number of density evaluations
    scale:      applied to colours, to scale their gradients as those of density were
    proposals:  of a proposal sampler, for its loss
    field:      evaluated one; None for the method's
    """

    name: str
    samples: Samples
    density: Float[Tensor, " sample"]
    features: Features
    directions: Float[Tensor, "coloured 3"]
    coloured: Int[Tensor, " coloured"] | None = None
    rgb: Float[Tensor, "sample 3"] | None = None
    evaluated: int = 0
    scale: Callable[[Tensor], Tensor] | None = None
    proposals: Any = None
    field: Field | None = None

    def look(self, field: Field, code: Float[Tensor, "ray code"] | None = None) -> Look:
        """Density and colour of all samples. code: of each ray"""
        rgb = self.rgb
        if rgb is None:
            rgb = (self.field or field).colour(self.features, self.directions, self.code_of_samples(code))
        if self.coloured is not None:
            rgb = rgb.new_zeros(len(self.samples), 3).index_copy(0, self.coloured, rgb)
        return Look(self.name, self.samples, self.density, self.scale(rgb) if self.scale else rgb)

    def keep(self, mask: Bool[Tensor, " sample"]) -> Pass:
        """The samples in a mask, of a pass whose samples all get a colour later."""
        features = tuple(x[mask] for x in self.features) if isinstance(self.features, tuple) else self.features[mask]
        samples, density, directions = self.samples.keep(mask), self.density[mask], self.directions[mask]
        return replace(self, samples=samples, density=density, features=features, directions=directions)

    def code_of_samples(self, code: Float[Tensor, "ray code"] | None) -> Float[Tensor, "coloured code"] | None:
        """The codes of rays, one for each sample that gets a colour."""
        if code is None:
            return None
        rays = self.samples.ray_index
        return codes_at(rays if self.coloured is None else rays[self.coloured], code)


def codes_at(rays: Int[Tensor, " sample"], code: Float[Tensor, "ray code"]) -> Float[Tensor, "sample code"]:
    """Code of each sample's ray. An embedding's gradient is the fastest of all look-ups."""
    return code.expand(len(rays), -1) if len(code) == 1 else embedding(rays, code)


class Sampler(Part):
    """Chooses where along rays a field is evaluated, with its initialisation, schedule, loss terms, optimizer and
    storage.

    is_open:        whether it samples unbounded rays
    batch_size:     number of rays of the next step
    expected_rays:  number of rays of a typical step
    rays_per_chunk: number of rays in a rendering chunk
    evaluated:      number of density evaluations in the last training step
    """

    is_open: ClassVar[bool] = False
    batch_size: int
    expected_rays: float
    rays_per_chunk: int = 16_384
    evaluated: int = 0

    @abstractmethod
    def sample(
        self, rays: Rays, field: Field, code: RayCodes | None = None, generator: torch.Generator | None = None
    ) -> list[Pass]:
        """Passes along rays, the composited one last.

        code:      of each ray
        generator: of jitter in training; None in rendering, with fixed positions
        """

    def terms(self, density: Density, last: Pass, generator: torch.Generator) -> dict[str, Tensor]:
        """Loss terms by name. density: of the field, per scene unit. last: the composited pass"""
        return {}

    def begin_from(self, teacher: Any, chance: torch.Generator) -> None:
        """Initialise from a teacher (`components.fields.teacher`), instead of `begin`."""

    def settle(self, density: Density, chance: torch.Generator) -> None:
        """Update after distillation of the field from a teacher. density: per scene unit"""

    def release(self) -> None:
        """Free data that only sampling needs, after the field is baked."""
