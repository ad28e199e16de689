"""Region of an object: seen by nearly all cameras, above its ground plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .view import ObjectView

GRID_SIDE = 56  # cells along each side of the searched cube
MIN_VIEW_SHARE = 0.7  # share of the views whose picture must contain a cell of the object
MIN_LEVEL_COSINE = 0.9  # between a table's normal and up
MIN_TABLE_SHARE = 0.06  # of the points nearby that lie on a table
MAX_BELOW_SHARE = 0.1  # of the points nearby that may lie below a table
TABLE_THICKNESS = 0.015  # of the cube's half-size
RANSAC_TRIALS = 500  # of three points each (RANSAC, Fischler and Bolles 1981)


@dataclass(frozen=True)
class TablePlane:
    """A plane below the object: points with normal . x > height are above it."""

    normal: Float[Tensor, " 3"]
    height: float

    def above(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Height of points above the plane, scene units."""
        return points @ self.normal - self.height


@dataclass(frozen=True)
class Region:
    """Cells that the object may fill.

    cells: their middles
    size:  their side
    table: what it stands on, where points tell
    """

    cells: Float[Tensor, "cell 3"]
    size: float
    table: TablePlane | None

    def holds(self, points: Float[Tensor, "point 3"]) -> Bool[Tensor, " point"]:
        """Mask of the points that lie in one of the cells."""
        if not len(points):
            return torch.zeros(0, dtype=torch.bool)
        low = self.cells.amin(0) - 0.5 * self.size
        filled = torch.zeros((GRID_SIDE + 2,) * 3, dtype=torch.bool)
        filled[((self.cells - low) / self.size).long().unbind(-1)] = True
        index = ((points - low) / self.size).floor().long()
        inside = ((index >= 0) & (index < GRID_SIDE)).all(-1)
        return inside & filled[index.clamp(0, GRID_SIDE + 1).unbind(-1)]


def find_region(views: Sequence[ObjectView], points: Float[Tensor, "point 3"] | None) -> Region:
    """The cells of [-1, 1]^3 that most pictures hold and that are above the table, if sparse points show one."""
    size = 2 / GRID_SIDE
    axis = torch.linspace(-1 + 0.5 * size, 1 - 0.5 * size, GRID_SIDE)
    cells = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    seen = np.mean([view.at(cells)[1] for view in views], 0)
    cells = cells[torch.from_numpy(seen) >= MIN_VIEW_SHARE]
    table = None if points is None else find_table(points)
    if table is not None:
        cells = cells[table.above(cells) > 0.5 * TABLE_THICKNESS]
    return Region(cells, size, table)


def find_table(points: Float[Tensor, "point 3"]) -> TablePlane | None:
    """The level plane that most points nearby lie on and hardly any below; None where there is none."""
    near = points[points.abs().amax(-1) < 1.5].double()
    if len(near) < 50:
        return None
    chance = torch.Generator().manual_seed(0)
    three = near[torch.randint(0, len(near), (RANSAC_TRIALS, 3), generator=chance)]
    normals = torch.linalg.cross(three[:, 1] - three[:, 0], three[:, 2] - three[:, 0])
    normals = normals / normals.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    normals = normals * normals[:, 2:].sign()
    heights = (normals * three[:, 0]).sum(-1)
    away = near @ normals.T - heights
    on, below = (away.abs() < TABLE_THICKNESS).double().mean(0), (away < -2 * TABLE_THICKNESS).double().mean(0)
    score = torch.where((normals[:, 2] > MIN_LEVEL_COSINE) & (below < MAX_BELOW_SHARE), on, 0.0)
    best = int(score.argmax())
    if score[best] < MIN_TABLE_SHARE:
        return None
    some = near[away[:, best].abs() < TABLE_THICKNESS]
    middle = some.mean(0)
    normal = torch.linalg.svd(some - middle, full_matrices=False).Vh[2]
    normal = normal * normal[2].sign()
    return TablePlane(normal.float(), float(normal @ middle))
