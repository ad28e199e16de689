"""Crop: a box or a sphere that bounds the used part of a scene."""

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
    """A part of space, in plain numbers, so that equal crops compare equal.

    convex: whether a ray is inside all the way between entry and exit
    """

    convex: ClassVar[bool] = True

    @abstractmethod
    def holds(self, points: Float[Tensor, "*point 3"], tolerance: float = 0.0) -> Bool[Tensor, "*point"]:
        """True for points inside, or outside by at most a tolerance (a share of the size)."""

    @abstractmethod
    def through(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Float[Tensor, " ray"]]:
        """Entry and exit distances of each ray; exit is before entry for a miss."""

    @abstractmethod
    def transformed(self, place: Similarity) -> Crop:
        """The same part of space in another frame. place: from this frame to that one"""

    @property
    @abstractmethod
    def bounds(self) -> tuple[Vector, Vector]:
        """The lower and the upper corner of the smallest upright box around it."""

    def coloured(self, points: Float[Tensor, "point 3"], rgb: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Colours of a field at points of the part, such as for a preview."""
        return rgb

    def entered(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Bool[Tensor, " ray"]]:
        """Distance of each ray's first point inside, 0 for an origin inside, and a mask of rays that enter at all."""
        enter, leave = self.through(rays)
        enter = enter.clamp_min(0)
        return enter, enter < leave


@dataclass(frozen=True)
class CropBox(Crop):
    """A box by its lower and upper corner.

    place: similarity from the frame in which the box is axis-aligned
    """

    lower: Vector
    upper: Vector
    place: Rows = IDENTITY_ROWS

    @property
    def corners(self) -> Float[Tensor, "8 3"]:
        """Corners in double precision, indexed by bits; adjacent corners differ in one bit."""
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

    def transformed(self, place: Similarity) -> CropBox:
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
    """A sphere by its centre and radius."""

    middle: Vector
    radius: float

    def holds(self, points: Float[Tensor, "*point 3"], tolerance: float = 0.0) -> Bool[Tensor, "*point"]:
        return (points - torch.tensor(self.middle).to(points)).norm(dim=-1) <= (1 + tolerance) * self.radius

    def through(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Float[Tensor, " ray"]]:
        """Solve |o + t d - m| = r: t = b ± sqrt(r^2 - a^2), b the distance along the ray of its point closest to m, a
        that point's distance from m."""
        away = torch.tensor(self.middle).to(rays.origins) - rays.origins
        nearest = (away * rays.directions).sum(-1)
        beside = (away - nearest[:, None] * rays.directions).square().sum(-1)
        half = (self.radius**2 - beside).clamp_min(0).sqrt()
        hit = beside < self.radius**2
        return torch.where(hit, nearest - half, torch.inf), torch.where(hit, nearest + half, -torch.inf)

    def transformed(self, place: Similarity) -> Sphere:
        x, y, z = place.points(torch.tensor(self.middle, dtype=torch.float64)).tolist()
        return Sphere((x, y, z), self.radius * place.scale)

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        (x, y, z), r = self.middle, self.radius
        return (x - r, y - r, z - r), (x + r, y + r, z + r)
