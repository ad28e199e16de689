"""A field whose colours depend on a code of each photograph: its light, its exposure (Martin-Brualla et al. 2021)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import embedding

from ...camera.rays import Rays, Samples
from ...datasets.scene import Scene


@dataclass(frozen=True)
class Places:
    """Where rays were looked at in one pass, and what is there for every photograph alike.

    density:  of what stays, per scene unit
    seen:     what the colour head takes of each sample beside an appearance
    unseen:   what the transient head takes of each sample beside a transient code
    stretch:  the field's own units of length in a scene unit
    asked:    samples that the field was asked about to find these
    """

    name: str
    samples: Samples
    density: Float[Tensor, " sample"]
    seen: tuple[Float[Tensor, "sample _"], Float[Tensor, "sample _"]]
    unseen: Float[Tensor, "sample feature"]
    stretch: Float[Tensor, " sample"]
    asked: int

    def keep(self, mask: Bool[Tensor, " sample"]) -> Places:
        """The samples that a mask picks."""
        seen = self.seen[0][mask], self.seen[1][mask]
        samples, unseen, stretch = self.samples.keep(mask), self.unseen[mask], self.stretch[mask]
        return replace(self, samples=samples, density=self.density[mask], seen=seen, unseen=unseen, stretch=stretch)


class CodedField(nn.Module, ABC):
    """What holds a scene: places along rays, and their colour under an appearance or another code.

    rays_per_chunk: rendered at once
    """

    rays_per_chunk: int

    @property
    @abstractmethod
    def batch_size(self) -> int:
        """Rays of the next step."""

    @abstractmethod
    def passes(self, rays: Rays, generator: torch.Generator | None = None) -> list[Places]:
        """Where to look along rays, the pass that is composited last. generator: of random places in training."""

    @abstractmethod
    def colour(self, places: Places, codes: Float[Tensor, "sample code"]) -> Float[Tensor, "sample 3"]:
        """sRGB-encoded colour in the light of each sample's appearance."""

    @abstractmethod
    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density of what stays, per scene unit."""

    @abstractmethod
    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"], code: Float[Tensor, " code"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """Density of what stays per scene unit, and its sRGB-encoded colour under one appearance."""

    @abstractmethod
    def optimizers(self, codes: list[nn.Parameter]) -> list[torch.optim.Optimizer]:
        """Of the field, and of the photographs' codes with it."""

    def behind(
        self, rays: Rays, codes: Float[Tensor, "ray code"], background: Float[Tensor, "#ray 3"]
    ) -> Float[Tensor, "#ray 3"]:
        """What shows behind everything under each ray's appearance: the background, or a sky."""
        return background

    def begin(self, scene: Scene, seconds: float, generator: torch.Generator) -> None:
        """Ahead of the first step; see `Method.begin`."""

    def further_terms(self, generator: torch.Generator) -> dict[str, Tensor]:
        """What the last `passes` cost beside colours, by name."""
        return {}

    def before_step(self, step: int, progress: float, generator: torch.Generator) -> None:
        """Ahead of each step; see `Method.before_step`."""

    def after_step(self, samples: float) -> None:
        """Once a step is done. samples: that it asked about"""


def of_samples(codes: Float[Tensor, "ray code"], places: Places) -> Float[Tensor, "sample code"]:
    """The code of each sample's ray. A lookup in an embedding, whose gradient is the quickest of a lookup's."""
    return embedding(places.samples.ray_index, codes)
