"""Occupancy grid for empty space skipping, and space carving (Kutulakos and Seitz 2000)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import max_pool2d, max_pool3d

from ... import kernels
from ...camera import PIXEL_RADIUS, Camera
from ...camera.rays import Rays, Samples
from ...datasets.scene import Scene
from ...files.ranges import Cells
from ...geometry import evenly
from ...method import Part
from ..fields.spaces import Space

VIEWS = 24  # photographs asked at most: more cut little further


@torch.no_grad()
def visual_hull(scene: Scene, resolution: int, coarsest: int = 32) -> Bool[Tensor, "x y z"]:
    """Visual hull: cells of a grid over [-1, 1]^3 inside all silhouettes of training photographs with alpha.

    Conservative: a cell is removed only if some photograph is transparent over the whole projection of its bounding
    ball. All stay in a dynamic capture, where cells may be occupied at another time.
    """
    if scene.frame.times is not None:
        return torch.ones(resolution, resolution, resolution, dtype=torch.bool)
    train = scene.splits["train"]
    chosen = evenly(train.tolist(), VIEWS)
    photographs = [scene.photograph(index) for index in chosen]
    views = [(photograph.camera, photograph.alpha) for photograph in photographs if photograph.alpha is not None]
    n = coarsest
    hull = torch.ones(n, n, n, dtype=torch.bool)
    while True:
        cells = hull.nonzero()
        for camera, alpha in views:
            centres = (cells + 0.5) * (2 / n) - 1
            cells = cells[~_seen_through(camera, alpha, centres, math.sqrt(3) / n)]
        hull = torch.zeros_like(hull)
        hull[tuple(cells.t())] = True
        if n >= resolution:
            return hull
        n *= 2
        hull = hull.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)


def _seen_through(
    camera: Camera, alpha: Float[Tensor, "height width"], centres: Float[Tensor, "cell 3"], radius: float
) -> Bool[Tensor, " cell"]:
    """Mask of balls with completely transparent projections; False for balls outside the picture."""
    if not len(centres):
        return torch.zeros(0, dtype=torch.bool)
    height, width = alpha.shape
    per_pixel = float(camera.rays(torch.tensor([[width / 2, height / 2]])).radius) / PIXEL_RADIUS
    nearest = float((centres - camera.position).norm(dim=-1).min()) - radius
    if nearest <= radius:
        return torch.zeros(len(centres), dtype=torch.bool)
    reach = math.ceil(radius / (nearest * per_pixel)) + 1
    around = alpha[None]
    for size in ((2 * reach + 1, 1), (1, 2 * reach + 1)):
        around = max_pool2d(around, size, 1, (size[0] // 2, size[1] // 2))
    places, inside = camera.locate(centres)
    return inside & (around[0][places.unbind(-1)] == 0)


class OccupancyGrid(nn.Module):
    """Occupancy grid in cascades: cubes of n^3 cells around the origin, each twice as large as the last (Müller 2022,
    appendix E.2).

    density:  decaying maximum of the density in each cell, per scene unit
    occupied: mask of occupied cells
    It begins coarse, where a few thousand samples find empty space, and `refine` halves its cells.
    """

    grows: ClassVar[tuple[str, ...]] = ("density", "occupied", "possible")
    density: Tensor
    occupied: Tensor
    possible: Tensor
    box: Tensor

    def __init__(self, reach: float, resolution: int):
        super().__init__()
        cascades = self.cascades_of(reach)
        self.register_buffer("density", torch.zeros(cascades, resolution, resolution, resolution))
        self.register_buffer("occupied", torch.ones(cascades, resolution, resolution, resolution, dtype=torch.bool))
        self.register_buffer("possible", torch.ones_like(self.occupied))
        # The box around all occupied cells: rays begin and end there.
        self.register_buffer("box", torch.tensor([[-1.0] * 3, [1.0] * 3]) * 2.0 ** (cascades - 1))

    @staticmethod
    def cascades_of(reach: float) -> int:
        """Number of cascades for a scene's reach."""
        return 1 + max(0, math.ceil(math.log2(reach)))

    @classmethod
    def bytes_of(cls, reach: float, resolution: int) -> int:
        """Bytes of a grid at its final resolution: a density and two masks for each cell."""
        return cls.cascades_of(reach) * resolution**3 * (4 + 1 + 1)

    @property
    def resolution(self) -> int:
        return self.density.shape[-1]

    @property
    def share(self) -> float:
        """Share of cells that are occupied."""
        return float(self.occupied.float().mean())

    def refine(self) -> None:
        """Halve the cells; each inherits its parent's density and state."""
        for name in self.grows:
            grid = getattr(self, name)
            for axis in (1, 2, 3):
                grid = grid.repeat_interleave(2, axis)
            setattr(self, name, grid)

    def rule_out(self, possible: Bool[Tensor, "cascade x y z"]) -> None:
        """Mark cells as permanently empty, whatever the field's density there; their grid sets the resolution."""
        self.possible = possible.to(self.density.device)
        self.occupied, self.density = self.possible.clone(), torch.zeros_like(self.possible, dtype=torch.float32)
        self.box.copy_(self._box())

    def sample(
        self,
        rays: Rays,
        near: float,
        step: float,
        growth: float = 0.0,
        stop: float = 0.0,
        jitter: Float[Tensor, " ray"] | None = None,
    ) -> Samples:
        """Samples in occupied cells, with early termination by the grid's own density (see `kernels.march`).

        jitter: in [0, 1), shifts each ray's lattice by that share of a step
        """
        enter, leave = rays.through_box(self.box)
        # Whole steps from the near distance, so that the lattice does not follow the box.
        enter = near + ((enter - near) / step).floor().clamp_min(0) * step if growth == 0 else enter.clamp_min(near)
        if jitter is not None:
            enter = enter + (jitter - 1) * (step if growth == 0 else (growth * enter).clamp_min(step))
            enter = enter.clamp_min(0)
        grids = self.occupied, self.density
        return kernels.march(rays.origins, rays.directions, enter, leave, *grids, step, growth, stop)

    @torch.no_grad()
    def update(
        self,
        density_at: Callable[[Float[Tensor, "sample 3"]], Float[Tensor, " sample"]],
        thickness: float,
        generator: torch.Generator,
        decay: float = 0.95,
        share: float = 1.0,
        budget: int | None = None,
    ) -> None:
        """Update densities at one random point in each of some cells, and threshold them again.

        thickness: optical thickness across an occupied cell, at least, or the mean density of all cells if less
        share:     below 1, only occupied cells and that share of all cells, at random, are updated
        budget:    largest number of evaluations, half of them in occupied cells; cells then take turns
        """
        flat = self.density.view(-1)
        cells = self._choose(share, budget, generator)
        flat[cells] *= decay
        for part in cells.split(1 << 18):
            seen = density_at(self._point_in(part, generator))
            flat[part] = torch.maximum(flat[part], seen)
        sizes = 2.0 ** torch.arange(len(self.density), device=flat.device) * 2 / self.resolution
        enough = (thickness / sizes).clamp(max=float(self.density.mean()))
        self.occupied = self.possible & (self.density > enough[:, None, None, None])
        self.box.copy_(self._box())

    def _choose(self, share: float, budget: int | None, generator: torch.Generator) -> Int[Tensor, " cell"]:
        possible, occupied = self.possible.view(-1), self.occupied.view(-1)
        if share >= 1:
            return possible.nonzero()[:, 0]
        probes = min(int(share * len(possible)), budget // 2 if budget else len(possible))
        drawn = torch.randint(len(possible), (probes,), generator=generator).to(possible.device)
        known = occupied.nonzero()[:, 0]
        if budget and len(known) > budget // 2:
            known = known[torch.randint(len(known), (budget // 2,), generator=generator).to(known.device)]
        chosen = torch.zeros_like(occupied)
        chosen[drawn] = chosen[known] = True
        return (chosen & possible).nonzero()[:, 0]

    def _point_in(self, cells: Int[Tensor, " cell"], generator: torch.Generator) -> Float[Tensor, "cell 3"]:
        n = self.resolution
        index = torch.stack([cells // (n * n) % n, cells // n % n, cells % n], -1)
        inside = torch.rand(len(cells), 3, generator=generator).to(cells.device)
        half = 2.0 ** (cells // n**3).float()
        return ((index + inside) * (2 / n) - 1) * half[:, None]

    def _box(self) -> Float[Tensor, "2 3"]:
        """Corners of the bounding box of all occupied cells."""
        low, high = torch.full((3,), torch.inf), torch.full((3,), -torch.inf)
        for cascade, occupied in enumerate(self.occupied.cpu()):
            half = 2.0**cascade
            for axis in range(3):
                others = [a for a in range(3) if a != axis]
                hit = occupied.any(dim=others[1]).any(dim=others[0]).nonzero()[:, 0]
                if len(hit):
                    low[axis] = min(low[axis], (hit[0] * 2 / self.resolution - 1) * half)
                    high[axis] = max(high[axis], ((hit[-1] + 1) * 2 / self.resolution - 1) * half)
        return torch.stack([low, high]).to(self.box)


OCCUPANCY_THRESHOLD = 0.01  # optical thickness of a cell below which it is empty
BEGINS = 0.1  # share of the budget before the grid rules anything out: a young network is thin everywhere
EVERY, DECAY = 16, 0.95  # steps between looks at the grid, and what it remembers of the last one
LOOKS = 1 << 15  # at the grid, each time
PROBES = 0.02  # share of all cells looked at again at random, in case something has grown there


@dataclass(frozen=True)
class MaskNumbers:
    """A Config's numbers of the mask of empty space."""

    occupancy_resolution: Cells = 0  # cells per axis of the occupancy grid; 0: no grid, samples everywhere


class OccupancyMask(Part):
    """Occupancy mask over the cube of coordinates, [-1, 1]^3, for a coordinate network.

    cells:     along each axis; the hull of an object may refine them. 0: no mask
    thickness: optical thickness across an empty cell, at most
    """

    known: Tensor

    def __init__(self, cells: int, thickness: float = OCCUPANCY_THRESHOLD):
        super().__init__()
        self.cells, self.thickness = cells, thickness
        if cells:
            self.grid = OccupancyGrid(1.0, self.cells)
            self.register_buffer("known", torch.tensor(False))
            self._coarser: tuple[Tensor, dict[int, Tensor]] = self.grid.occupied, {}

    def begin(self, method: Any, data: Scene, seconds: float) -> None:
        """Mark the cells outside the visual hull of an object as permanently empty, unless poses are optimised:
        silhouettes with wrong poses would carve the object."""
        if self.cells and data.images.has_alpha and not data.frame.is_open and not method.moves_cameras:
            self.grid.rule_out(visual_hull(data, self.cells)[None])

    def begin_from(self, teacher: Any, space: Space, chance: torch.Generator) -> None:
        """Mark the cells that are empty in a teacher as permanently empty."""
        if self.cells:
            self.grid.rule_out(teacher.occupied(space, self.cells, self.thickness, chance)[None])

    def before_step(self, method: Any, step: int, progress: float) -> None:
        """Update the mask every EVERY steps, by the density of the method's `CoordinateField`."""
        if not self.cells or progress < BEGINS or step % EVERY:
            return
        share, looks = (PROBES, LOOKS) if self.known else (1.0, None)  # everywhere for once
        self.grid.update(method.network.density_at, self.thickness, method.random(~step), DECAY, share, looks)
        self.known.fill_(True)

    def may_hold(
        self, coordinates: Float[Tensor, "sample 3"], radius: Float[Tensor, " sample"] | None = None
    ) -> Bool[Tensor, " sample"] | None:
        """Mask of coordinates with an occupied cell within a radius; None without a mask. Clamped to the grid."""
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
        """Occupied cells 2^level times as large, dilated by one; cached until the mask changes."""
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
