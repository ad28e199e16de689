"""OccupancyMask: where something may be, so that a coordinate network is evaluated only there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool3d

from ...datasets.scene import Scene
from ...files.ranges import Cells, NonNegative
from ...method import Part
from .occupancy import OccupancyGrid, visual_hull
from .spaces import Space

BEGINS = 0.1  # share of the budget before the grid rules anything out: a young network is thin everywhere
EVERY, DECAY = 16, 0.95  # steps between looks at the grid, and what it remembers of the last one
LOOKS = 1 << 15  # at the grid, each time
PROBES = 0.02  # share of all cells looked at again at random, in case something has grown there


@dataclass(frozen=True)
class MaskNumbers:
    """A Config's numbers of the mask of empty space."""

    occupancy_resolution: Cells = 0  # cells per axis of the occupancy grid; 0: no grid, samples everywhere
    occupancy_threshold: NonNegative = 0.01  # optical thickness of a cell below which it is empty; higher skips more


class OccupancyMask(Part):
    """A grid over the cube of coordinates, [-1, 1]^3, that remembers where a network found something.

    cells:     along each axis; the hull of an object may make them finer. 0: no grid, something may be anywhere
    thickness: optical thickness across a cell below which it is empty
    """

    known: Tensor

    def __init__(self, cells: int, thickness: float):
        super().__init__()
        self.cells, self.thickness = cells, thickness
        if cells:
            self.grid = OccupancyGrid(1.0, self.cells)
            self.register_buffer("known", torch.tensor(False))
            self._coarser: tuple[Tensor, dict[int, Tensor]] = self.grid.occupied, {}

    def begin(self, method: Any, data: Scene, seconds: float) -> None:
        """Mark as empty for good the cells that photographs of an object see through, unless poses are learnt:
        silhouettes seen from wrong poses would carve what is there."""
        if self.cells and data.images.has_alpha and not data.frame.is_open and not method.moves_cameras:
            self.grid.rule_out(visual_hull(data, self.cells)[None])

    def begin_from(self, teacher: Any, space: Space, chance: torch.Generator) -> None:
        """Mark as empty for good the cells in which a teacher holds nothing."""
        if self.cells:
            self.grid.rule_out(teacher.occupied(space, self.cells, self.thickness, chance)[None])

    def before_step(self, method: Any, step: int, progress: float) -> None:
        """Update the grid every EVERY steps, by the density of the method's `CoordinateField`."""
        if not self.cells or progress < BEGINS or step % EVERY:
            return
        share, looks = (PROBES, LOOKS) if self.known else (1.0, None)  # everywhere for once
        self.grid.update(method.network.density_at, self.thickness, method.random(~step), DECAY, share, looks)
        self.known.fill_(True)

    def may_hold(
        self, coordinates: Float[Tensor, "sample 3"], radius: Float[Tensor, " sample"] | None = None
    ) -> Bool[Tensor, " sample"] | None:
        """Mask of places with something within a radius; None without a grid. The nearest cell counts beyond it."""
        if not self.cells:
            return None
        if radius is None:
            return self.grid.occupied.view(-1).index_select(0, self._cells_of(coordinates, 1))
        found = torch.zeros(len(coordinates), dtype=torch.bool, device=coordinates.device)
        level = (radius * (0.5 * self.grid.resolution)).clamp_min(1).log2().ceil()
        for k in range(int(level.max()) + 1 if len(level) else 0):
            here = (level == k).nonzero()[:, 0]
            found[here] = self._neighbourhood(k)[self._cells_of(coordinates[here], 2**k)]
        return found

    def _neighbourhood(self, level: int) -> Bool[Tensor, " cell"]:
        """Cells 2^level times as large that hold something themselves or beside them; kept until the grid changes."""
        if self._coarser[0] is not self.grid.occupied:
            self._coarser = self.grid.occupied, {}
        kept = self._coarser[1]
        if level not in kept:
            merged = max_pool3d(self.grid.occupied.float()[None], 2**level, ceil_mode=True)
            kept[level] = (max_pool3d(merged, 3, 1, 1) > 0).flatten()
        return kept[level]

    def _cells_of(self, coordinates: Float[Tensor, "sample 3"], size: int) -> Tensor:
        n = -(-self.grid.resolution // size)
        half = 0.5 * self.grid.resolution / size
        x, y, z = (coordinates * half + half).int().clamp_(0, n - 1).unbind(-1)  # 32 bits: half of what is to be moved
        return (x * n + y) * n + z
