"""Fusion of depth pictures into one signed distance (Curless and Levoy 1996)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..threads import processors
from . import depths
from .sightings import Sighting, located

PIECE = 10_000  # points; PyTorch shares out no operation on so few, and they stay in the nearest cache
FREE = 0.3  # weight, beside the cosine of a surface, of a pixel that shows none: it says that there is nothing


@dataclass(frozen=True)
class Fusion:
    """The weighted mean of what cameras say of the distance to the surface along their rays (eq. 1 and 2).

    truncation: distance from the surface at which it no longer matters, scene units; hidden points deeper than that
                are left to others
    A camera counts with the cosine at which it sees the surface, over the area of its pixel there (section 4).
    """

    sightings: Sequence[Sighting]
    truncation: float

    def __call__(self, points: Float[Tensor, "point 3"]) -> tuple[Float[Tensor, " point"], Bool[Tensor, " point"]]:
        """Signed distance over the truncation, in [-1, 1], positive inside, NaN where no camera sees; and whether any
        picture holds the point at all."""
        # Each thread takes whole pieces: beside other programs dozens of shared operations for each camera would wait,
        # every time, for the thread that was held up.
        with ThreadPoolExecutor(processors()) as pool:
            found = list(pool.map(self._fused, points.split(PIECE)))
        distance, pictured = (torch.cat(column) for column in zip(*found, strict=True))
        return distance, pictured

    @torch.no_grad()  # which holds for one thread
    def _fused(self, points: Float[Tensor, "point 3"]) -> tuple[Float[Tensor, " point"], Bool[Tensor, " point"]]:
        total, weight = torch.zeros(len(points)), torch.zeros(len(points))
        pictured = torch.zeros(len(points), dtype=torch.bool)
        for sighting in self.sightings:
            pixels, valid, away = located(sighting, points)
            given = pixels, valid, away, sighting.depth, sighting.facing
            sums = total, weight, pictured
            depths.fuse(*(x.numpy() for x in given), FREE, self.truncation, *(x.numpy() for x in sums))
        return torch.where(weight > 0, -total / weight, torch.nan), pictured
