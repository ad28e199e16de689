"""Sightings: how much training rays see of each part of a scene, so that what nobody sees need not be kept."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool3d, max_pool3d

REMEMBERED = 0.95  # of a weight, from one look back to the next
LEAST = 0.01  # weight in some ray's colour from which on a cell is seen


class Sightings(nn.Module):
    """A grid of n^3 cells over [-1, 1]^3 (Hedman 2021, section 5.1, culls by visibility likewise).

    weight: the largest that a sample in a cell had in a ray's colour lately
    """

    grows: ClassVar[tuple[str, ...]] = ("weight",)
    weight: Tensor

    def __init__(self, resolution: int):
        super().__init__()
        self.register_buffer("weight", torch.zeros(1, resolution, resolution, resolution))

    @torch.no_grad()
    def note(self, points: Float[Tensor, "sample 3"], weights: Float[Tensor, " sample"]) -> None:
        """Remember what rays see. weights: of samples at these points, in their rays' colours"""
        inside = self.inside(points)
        cells = self.cells(points[inside])
        self.weight.view(-1).scatter_reduce_(0, cells, weights[inside].detach(), "amax")

    def forget(self) -> None:
        """Make weights of long ago count for less."""
        self.weight *= REMEMBERED

    def release(self) -> None:
        """Hold nothing any more."""
        self.weight = self.weight.new_zeros(1, 1, 1, 1)

    @property
    def resolution(self) -> int:
        return self.weight.shape[-1]

    @property
    def seen(self) -> Bool[Tensor, "x y z"]:
        """Cells that rays see, and those around them."""
        return max_pool3d((self.weight > LEAST).float(), 3, 1, 1)[0] > 0

    def inside(self, points: Float[Tensor, "sample 3"]) -> Bool[Tensor, " sample"]:
        return (points.abs() < 1).all(-1)

    def cells(self, points: Float[Tensor, "sample 3"]) -> Tensor:
        """Numbers of the cells that hold points."""
        n = self.resolution
        x, y, z = self.along(points).unbind(-1)
        return (x * n + y) * n + z

    def along(self, coordinates: Tensor) -> Tensor:
        """Which cells hold coordinates, along their axis."""
        n = self.resolution
        return ((coordinates + 1) * (0.5 * n)).long().clamp(0, n - 1)


def smoothed(ways: Float[Tensor, "x y z 3"]) -> Float[Tensor, "x y z 3"]:
    """The mean of each cell's vectors and those around it."""
    return avg_pool3d(ways.permute(3, 0, 1, 2)[None], 3, 1, 1)[0].permute(1, 2, 3, 0)
