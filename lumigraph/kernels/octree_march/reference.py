"""Reference implementation: the cells, their colours along each ray, compositing."""

import math

import torch
from torch import Tensor

from ..composite.reference import run as composite
from ..octree_cells import Tree
from ..octree_cells.reference import run as crossed
from ..spherical_harmonics.reference import run as basis


def run(
    origins: Tensor, directions: Tensor, tree: Tree, density: Tensor, harmonics: Tensor, near: float, stop: float
) -> tuple[Tensor, Tensor, Tensor]:
    origins, directions = origins.detach(), directions.detach()
    start, end, ray_starts, rows = crossed(origins, directions, tree, density.detach(), near, stop)
    ray = torch.arange(len(origins), device=rows.device).repeat_interleave(ray_starts.diff())
    bands = math.isqrt(harmonics.shape[1])
    rgb = (basis(directions, bands)[ray][:, :, None] * harmonics[rows]).sum(1).sigmoid()
    values = torch.cat([rgb, 0.5 * (start + end)[:, None]], 1)
    total, opacity, _ = composite(density[rows] * (end - start), values, ray_starts, stop)
    return total[:, :3], total[:, 3], opacity
