"""Trainable voxel grids: values at voxel corners in a box, which may be refined and shrunk."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ... import kernels
from ..training.row_optimizers import exchange

CORNERS_PER_CHUNK = 1 << 20  # corners that are looked up at a time where a grid is made anew

Finer = tuple[float, float, float]
Box = Float[Tensor, "2 3"]  # the lower corner and the upper


def shape_of(sides: Float[Tensor, " 3"] | list[float], voxels: int) -> tuple[int, int, int]:
    """Corners along each axis, two at least, of about `voxels` cubic voxels in a box with these sides."""
    sides = [float(x) for x in sides]
    edge = (math.prod(sides) / voxels) ** (1 / 3)
    x, y, z = (max(1, round(side / edge)) + 1 for side in sides)
    return x, y, z


def corners(box: Box, shape: tuple[int, int, int]) -> Float[Tensor, "corner 3"]:
    """Coordinates of a grid's corners, the last axis fastest."""
    axes = [torch.linspace(0, 1, n, device=box.device) for n in shape]
    return box[0] + torch.cartesian_prod(*axes) * (box[1] - box[0])


def tight_box(box: Box, inside: Bool[Tensor, "x y z"]) -> Box:
    """Smallest box around the corners of a mask, with a margin of a voxel; the whole box for an empty mask.

    Too large a box wastes voxels on empty space; a box that cuts something off turns it into background.
    """
    if not inside.any():
        return box.clone()
    size = torch.tensor(inside.shape, device=box.device)
    found = inside.nonzero()
    low, high = (found.amin(0) - 1).clamp_min(0), torch.minimum(found.amax(0) + 1, size - 1)
    return box[0] + torch.stack([low, high]) / (size - 1) * (box[1] - box[0])


class VoxelGrid(nn.Module):
    """Channels at the corners of a box's voxels, initially zero, with trilinear interpolation (see
    `kernels.dense_grid`).

    values: (corner, channel), the last axis fastest; `size` is the number of corners along each
    finer: ratio of voxels along each axis to those of cubes; initially cubes
    Coordinates beyond the box are clamped.
    """

    grows: ClassVar[tuple[str, ...]] = ("values",)
    size: Tensor
    box: Tensor

    def __init__(self, box: list[list[float]], voxels: int, channels: int, finer: Finer = (1.0, 1.0, 1.0)):
        super().__init__()
        self.finer = finer
        shape = self._shape(torch.tensor(box, device="cpu"), voxels)
        self.register_buffer("size", torch.tensor(shape))
        self.register_buffer("box", torch.tensor(box))
        self.values = nn.Parameter(torch.zeros(math.prod(shape), channels))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Corners along each axis."""
        x, y, z = self.size.tolist()
        return x, y, z

    @property
    def edge(self) -> float:
        """Edge of a cube with a voxel's volume."""
        return float(((self.box[1] - self.box[0]) / (self.size - 1)).prod() ** (1 / 3))

    @property
    def longest(self) -> float:
        """Longest edge of a voxel."""
        return float(((self.box[1] - self.box[0]) / (self.size - 1)).max())

    def forward(self, coordinates: Float[Tensor, "sample 3"]) -> Float[Tensor, "sample channel"]:
        return kernels.dense_grid(coordinates, self.values.view(*self.shape, -1), self.box)

    @torch.no_grad()
    def rebuild(self, box: Box, voxels: int, optimizer: torch.optim.Optimizer | None = None) -> None:
        """Resample to about `voxels` voxels in a box within the current one. The parameter is replaced; its optimizer
        state is reset."""
        shape = self._shape(box, voxels)
        values = torch.cat([self(part) for part in corners(box, shape).split(CORNERS_PER_CHUNK)])
        self.size.copy_(torch.tensor(shape))
        self.box.copy_(box)
        self.replace(values.contiguous(), optimizer)

    def _shape(self, box: Box, voxels: int) -> tuple[int, int, int]:
        return shape_of((box[1] - box[0]).cpu() * torch.tensor(self.finer, device="cpu"), voxels)

    def replace(self, values: Float[Tensor, "corner channel"], optimizer: torch.optim.Optimizer | None = None) -> None:
        """Replace the values, of any number, as a new parameter; its moments are zero."""
        exchange(self, "values", values, optimizer)

    def variation(
        self, coordinates: Float[Tensor, "sample 3"], count: int, generator: torch.Generator
    ) -> Float[Tensor, ""]:
        """Total variation at the voxels of some random samples; see `kernels.total_variation`.

        Only values with another gradient in the step get one: an optimizer that normalises gradients would move the
        others as far for smoothness alone.
        count: number of samples, with repetition
        """
        drawn = torch.randint(len(coordinates), (count,), generator=generator).to(coordinates.device)
        places = (coordinates[drawn] - self.box[0]) / (self.box[1] - self.box[0])
        x, y, z = (places.clamp(0, 1) * (self.size - 1)).long().unbind(-1)
        chosen = (x * self.size[1] + y) * self.size[2] + z
        return kernels.total_variation(chosen, all_nodes(self.shape, str(chosen.device)), self.values)


@lru_cache(maxsize=2)  # of this stage's grid, and of another one's
def all_nodes(shape: tuple[int, int, int], device: str) -> kernels.Nodes:
    """All nodes of a dense grid."""
    return kernels.Nodes.all(shape).to(device)
