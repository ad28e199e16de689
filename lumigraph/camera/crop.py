"""Crop: a box or a sphere that says which part of a scene counts."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..geometry import Rows, Similarity, Vector
from .rays import Rays

IDENTITY_ROWS: Rows = Similarity.make(1.0).rows


class Crop(ABC):
    """A part of space, by plain numbers, so that two are equal if they say the same.

    convex: whether all between where a ray enters and leaves is inside
    """

    convex: ClassVar[bool] = True

    @abstractmethod
    def holds(self, points: Float[Tensor, "*point 3"], tolerance: float = 0.0) -> Bool[Tensor, "*point"]:
        """True for points inside, or outside by at most a tolerance (a share of the size)."""

    @abstractmethod
    def through(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Float[Tensor, " ray"]]:
        """Distances at which each ray enters and leaves; it leaves before it enters where it misses."""

    @abstractmethod
    def moved(self, place: Similarity) -> Crop:
        """The same part of space as another frame says it. place: from this frame to that one."""

    @property
    @abstractmethod
    def bounds(self) -> tuple[Vector, Vector]:
        """The lower and the upper corner of the smallest upright box around it."""

    def coloured(self, points: Float[Tensor, "point 3"], rgb: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Colours of a field at points of the part."""
        return rgb

    def entered(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Bool[Tensor, " ray"]]:
        """Distance at which each ray is first inside, 0 for one that begins inside, and whether it ever is."""
        enter, leave = self.through(rays)
        enter = enter.clamp_min(0)
        return enter, enter < leave


@dataclass(frozen=True)
class CropBox(Crop):
    """A box by two corners, of which lower is nowhere above upper.

    place: similarity from the frame in which the corners are said and the sides are upright
    """

    lower: Vector
    upper: Vector
    place: Rows = IDENTITY_ROWS

    @property
    def corners(self) -> Float[Tensor, "8 3"]:
        """In double precision; the numbers of two that share an edge differ in one bit."""
        ends = zip(self.lower, self.upper, strict=True)
        return self._place.points(torch.tensor(list(itertools.product(*ends)), dtype=torch.float64))

    def holds(self, points: Float[Tensor, "*point 3"], tolerance: float = 0.0) -> Bool[Tensor, "*point"]:
        points = points if self.place == IDENTITY_ROWS else self._place.inverse.points(points)
        lower, upper = torch.tensor((self.lower, self.upper)).to(points)
        margin = tolerance * (upper - lower)
        return ((points >= lower - margin) & (points <= upper + margin)).all(-1)

    def through(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Float[Tensor, " ray"]]:
        here = self._place
        if self.place != IDENTITY_ROWS:
            back = here.inverse
            rays = replace(rays, origins=back.points(rays.origins), directions=back.directions(rays.directions))
        enter, leave = rays.through_box(rays.origins.new_tensor((self.lower, self.upper)))
        return enter * here.scale, leave * here.scale

    def moved(self, place: Similarity) -> CropBox:
        return replace(self, place=(place @ self._place).rows)

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        (a, b, c), (d, e, f) = self.corners.amin(0).tolist(), self.corners.amax(0).tolist()
        return (a, b, c), (d, e, f)

    @property
    def _place(self) -> Similarity:
        return Similarity.of(self.place)


@dataclass(frozen=True)
class Sphere(Crop):
    """A sphere by its middle and radius."""

    middle: Vector
    radius: float

    def holds(self, points: Float[Tensor, "*point 3"], tolerance: float = 0.0) -> Bool[Tensor, "*point"]:
        return (points - torch.tensor(self.middle).to(points)).norm(dim=-1) <= (1 + tolerance) * self.radius

    def through(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Float[Tensor, " ray"]]:
        """Solve |o + t d - m| = r: t = b ± sqrt(r^2 - a^2), where b is how far along m is nearest, and a how near."""
        away = torch.tensor(self.middle).to(rays.origins) - rays.origins
        nearest = (away * rays.directions).sum(-1)
        beside = (away - nearest[:, None] * rays.directions).square().sum(-1)
        half = (self.radius**2 - beside).clamp_min(0).sqrt()
        hit = beside < self.radius**2
        return torch.where(hit, nearest - half, torch.inf), torch.where(hit, nearest + half, -torch.inf)

    def moved(self, place: Similarity) -> Sphere:
        x, y, z = place.points(torch.tensor(self.middle, dtype=torch.float64)).tolist()
        return Sphere((x, y, z), self.radius * place.scale)

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        (x, y, z), r = self.middle, self.radius
        return (x - r, y - r, z - r), (x + r, y + r, z + r)
