"""Visibility grid: the weight of each part of a scene in training rays, so that invisible parts are not baked."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool3d, max_pool3d

from ...method import Part

DECAY = 0.95  # of a weight, at each interval
MIN_WEIGHT = 0.01  # weight in some ray's colour from which on a cell is visible


class VisibilityGrid(Part):
    """A grid of n^3 cells over [-1, 1]^3 (Hedman 2021, section 5.1, culls by visibility likewise).

    weight:   the largest recent weight of a sample in each cell in its ray's colour
    interval: steps after which weights decay
    """

    grows: ClassVar[tuple[str, ...]] = ("weight",)
    weight: Tensor

    def __init__(self, resolution: int, interval: int):
        super().__init__()
        self.interval = interval
        self.register_buffer("weight", torch.zeros(1, resolution, resolution, resolution))

    @torch.no_grad()
    def record(self, points: Float[Tensor, "sample 3"], weights: Float[Tensor, " sample"]) -> None:
        """Record what rays see. weights: of samples at these points, in their rays' colours"""
        inside = self.inside(points)
        cells = self.cells(points[inside])
        self.weight.view(-1).scatter_reduce_(0, cells, weights[inside].detach(), "amax")

    def before_step(self, method: Any, step: int, progress: float) -> None:
        if step % self.interval == 0:
            self.weight *= DECAY

    def release(self) -> None:
        """Drop all weights."""
        self.weight = self.weight.new_zeros(1, 1, 1, 1)

    @property
    def resolution(self) -> int:
        return self.weight.shape[-1]

    @property
    def visible(self) -> Bool[Tensor, "x y z"]:
        """Cells that rays see, and those around them."""
        return max_pool3d((self.weight > MIN_WEIGHT).float(), 3, 1, 1)[0] > 0

    def inside(self, points: Float[Tensor, "sample 3"]) -> Bool[Tensor, " sample"]:
        return (points.abs() < 1).all(-1)

    def cells(self, points: Float[Tensor, "sample 3"]) -> Int[Tensor, " sample"]:
        """Numbers of the cells that hold points."""
        n = self.resolution
        x, y, z = self.along(points).unbind(-1)
        return (x * n + y) * n + z

    def along(self, coordinates: Tensor) -> Tensor:
        """Numbers of the cells that hold coordinates, along their axis."""
        n = self.resolution
        return ((coordinates + 1) * (0.5 * n)).long().clamp(0, n - 1)


def smoothed(vectors: Float[Tensor, "x y z 3"]) -> Float[Tensor, "x y z 3"]:
    """The mean of each cell's vectors and those around it."""
    return avg_pool3d(vectors.permute(3, 0, 1, 2)[None], 3, 1, 1)[0].permute(1, 2, 3, 0)
