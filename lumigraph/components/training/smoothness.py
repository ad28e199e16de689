"""Smoothness: neighbouring voxels differ little, as a prior where photographs leave open what they hold."""

from __future__ import annotations

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from ...kernels import Nodes, total_variation
from ..fields.voxels import VoxelGrid


def variation(
    grid: VoxelGrid, coordinates: Float[Tensor, "sample 3"], count: int, generator: torch.Generator
) -> Float[Tensor, ""]:
    """Total variation of a grid at the voxels of some samples, drawn at random; see `kernels.total_variation`.

    Only what a step touches anyway gets a slope: an optimiser that scales slopes by their size would move the rest as
    far for smoothness' sake alone.
    count: samples to draw, of which one may come more than once
    """
    drawn = torch.randint(len(coordinates), (count,), generator=generator).to(coordinates.device)
    places = (coordinates[drawn] - grid.box[0]) / (grid.box[1] - grid.box[0])
    x, y, z = (places.clamp(0, 1) * (grid.size - 1)).long().unbind(-1)
    chosen = (x * grid.size[1] + y) * grid.size[2] + z
    return total_variation(chosen, _all(grid.shape, str(chosen.device)), grid.values)


@lru_cache(maxsize=2)  # of the stage that there is, and of another grid's
def _all(shape: tuple[int, int, int], device: str) -> Nodes:
    return Nodes.all(shape).to(device)
