"""Density and harmonics in the occupied cells of an octree."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import embedding

from ... import kernels
from ...camera.rays import Rays, Rendering
from ...errors import LumigraphError
from ...exchange.baked import Octree
from ...exchange.packing import Stored
from ...kernels.octree_cells import Crossed, Tree, code_of, levels_of
from ...kernels.octree_cells.reference import leaves
from ...method import Pass, Sampler
from ...method.field import Densities, Points
from ...method.sampler import RayCodes
from ...system.memory import free_on, gigabytes
from .harmonic_field import SphericalHarmonicsField


class Leaves(SphericalHarmonicsField):
    """The table of an octree's leaves. Values are constant within a leaf (Yu 2021, section 4).

    codes:     of the leaves, sorted along the space-filling curve (see `kernels.Tree`)
    densities: (row, 1) per scene unit; negative values count as 0
    harmonics: (row, 3 basis), before the sigmoid, colours next to each other
    low, size: corner and side of the root cube, in the scene's frame
    There are none at first.
    """

    grows: ClassVar[tuple[str, ...]] = ("codes", "densities", "harmonics")
    codes: Tensor
    low: Tensor
    size: Tensor
    densities: nn.Parameter
    harmonics: nn.Parameter

    def __init__(self, basis: int):
        super().__init__()
        self.basis = basis
        self.register_buffer("codes", torch.zeros(0, dtype=torch.int32))
        self.register_buffer("low", torch.full((3,), -1.0))
        self.register_buffer("size", torch.tensor(2.0))
        self.densities = nn.Parameter(torch.zeros(0, 1), requires_grad=False)
        self.harmonics = nn.Parameter(torch.zeros(0, 3 * basis), requires_grad=False)
        self._made: tuple[Tensor, int, Tree] | None = None

    def __len__(self) -> int:
        return len(self.codes)

    @staticmethod
    def bytes_of(rows: int, basis: int, learning: bool) -> int:
        """Bytes of leaves with their tree; learning takes twice more: mean squares, and the rows of a step."""
        return rows * (4 * (1 + 3 * basis) * (3 if learning else 1) + 64)

    @property
    def tree(self) -> Tree:
        """Tree of the leaves, built on first use, and again after codes were loaded or moved."""
        made = self._made
        if made is None or made[0] is not self.codes or made[1] != self.codes._version:
            made = self._made = self.codes, self.codes._version, Tree.of(self.codes)
        return made[2]

    # Along rays

    def crossed(self, rays: Rays, near: float, stop: float = 0.0) -> Crossed:
        """Leaves along rays, front to back, until termination; distances in scene units."""
        found = kernels.octree_cells(*self._within(rays), self.tree, self._thickness.detach(), *self._ends(near, stop))
        size = float(self.size)
        return Crossed(found.t_start * size, found.t_end * size, found.ray_starts, found.rows)

    def seen(
        self, rays: Rays, near: float, stop: float, background: Float[Tensor, "#ray 3"], part: Subtree | None = None
    ) -> Rendering:
        """Rendering of rays before a background colour. part: the rows through which gradients go; all by default"""
        tree, density, harmonics = part or (self.tree, self.densities, self.harmonics)
        thickness = density[:, 0].relu() * float(self.size)
        tables = thickness, harmonics.view(-1, self.basis, 3)
        rgb, distance, opacity = kernels.octree_march(*self._within(rays), tree, *tables, *self._ends(near, stop))
        rgb = rgb + (1 - opacity)[:, None] * background
        hit = opacity > 1e-3
        depth = torch.where(hit, distance * float(self.size) / opacity.clamp_min(1e-3), torch.inf)
        return Rendering(rgb, depth, opacity)

    @torch.no_grad()
    def touched(self, rays: Rays, near: float, stop: float) -> Int[Tensor, " some"]:
        """Ascending rows of leaves that rays cross before termination; on a GPU, where finding them takes longer,
        all rows."""
        if rays.origins.is_cuda:
            return torch.arange(len(self), device=rays.origins.device)
        marks = torch.zeros(len(self), dtype=torch.bool)
        marks[self.crossed(rays, near, stop).rows] = True
        return marks.nonzero()[:, 0]

    def part(self, rows: Int[Tensor, " some"]) -> Subtree:
        """A small table of some rows, to which a step's sparse gradient is confined."""
        density, harmonics = (embedding(rows, table, sparse=True) for table in (self.densities, self.harmonics))
        return self.tree.part(rows), density, harmonics

    @property
    def _thickness(self) -> Float[Tensor, " row"]:
        """Density per side of the cube."""
        return self.densities[:, 0].relu() * float(self.size)

    def _within(self, rays: Rays) -> tuple[Tensor, Tensor]:
        return (rays.origins - self.low) / float(self.size), rays.directions

    def _ends(self, near: float, stop: float) -> tuple[float, float]:
        return near / float(self.size), stop

    # At points

    def rows_at(self, points: Float[Tensor, "point 3"]) -> Int[Tensor, " point"]:
        """The row of the leaf that contains each point, -1 for none."""
        tree = self.tree
        place = ((points - self.low) * (2.0**tree.depth / float(self.size))).floor()
        inside = ((place >= 0) & (place < 1 << tree.depth)).all(-1)
        value, _ = leaves(tree, torch.where(inside[:, None], place, 0).long())
        return torch.where(inside & (value < 0), -1 - value, -1)

    def geometry(self, points: Points, code: Tensor | None = None) -> tuple[Densities, Float[Tensor, "point harmonic"]]:
        """Density and harmonics of the leaf that contains each point; zeros for none."""
        rows = self.rows_at(points)
        return self._rows(self.densities, rows)[:, 0].relu(), self._rows(self.harmonics, rows)

    def density(self, points: Float[Tensor, "point 3"], code: Tensor | None = None) -> Float[Tensor, " point"]:
        """Density per scene unit."""
        return self._rows(self.densities, self.rows_at(points))[:, 0].relu()

    def storage(self) -> dict[str, Stored]:
        """Harmonics by a codebook, density in 16 bits."""
        return {"densities": Stored("scaled", bits=16), "harmonics": Stored("coded")}

    def _rows(self, table: Float[Tensor, "row value"], rows: Int[Tensor, " point"]) -> Float[Tensor, "point value"]:
        found = table.new_zeros(len(rows), table.shape[1])
        there = (rows >= 0).nonzero()[:, 0]
        return found.index_copy(0, there, table[rows[there]])

    # As a whole

    @torch.no_grad()
    def keep(self, rows: Bool[Tensor, " row"]) -> None:
        """Keep only some rows; the cells of the others become empty."""
        self.codes = self.codes[rows]
        self.densities, self.harmonics = nn.Parameter(self.densities[rows]), nn.Parameter(self.harmonics[rows])

    @property
    def centres(self) -> tuple[Float[Tensor, "row 3"], Float[Tensor, " row"]]:
        """Centre and side of each leaf, in the scene's frame."""
        codes, levels = self.codes.long(), levels_of(self.codes.long())
        place = places_of(codes, levels)
        side = float(self.size) / 2.0**levels
        return self.low + (place + 0.5) * side[:, None], side

    @torch.no_grad()
    def octree(self) -> Octree:
        """The scene as an `Octree`: every cell of every divided one, with its values."""
        tree = self.tree
        cells = tree.cells.view(-1, 2, 2, 2)
        own = torch.arange(len(cells), dtype=torch.int32, device=cells.device)[:, None, None, None]
        child = torch.where(cells > 0, cells - own, 0)
        rows = torch.where(cells < 0, -1 - cells, -1).flatten().long()
        density = self._rows(self.densities, rows).relu().view(cells.shape)
        harmonics = self._rows(self.harmonics, rows).view(*cells.shape, self.basis, 3)
        return Octree(child, density, harmonics, self.low.clone(), float(self.size))

    @torch.no_grad()
    def coarser(self, depth: int) -> Leaves:
        """The octree with fewer levels: a cell has the mean density, and the harmonics weighted by density."""
        codes, levels = self.codes.long(), levels_of(self.codes.long())
        over = (levels - depth).clamp_min(0)
        merged, which = torch.unique(codes >> 3 * over, return_inverse=True)
        share = self.densities.relu() / 8.0 ** over[:, None]
        density = torch.zeros(len(merged), 1, device=share.device).index_add_(0, which, share)
        harmonics = torch.zeros(len(merged), self.harmonics.shape[1], device=share.device)
        harmonics.index_add_(0, which, share * self.harmonics)
        found = Leaves(self.basis).to(share.device)
        found.low, found.size = self.low.clone(), self.size.clone()
        order = in_space(merged)
        found.codes = merged[order].int()
        found.densities = nn.Parameter(density[order])
        found.harmonics = nn.Parameter((harmonics / density.clamp_min(1e-9))[order])
        return found


def ask_for_octree(leaves: Leaves, depth: int | None = None) -> None:
    """Raise LumigraphError if an `Octree` exceeds memory, all cells of all nodes written out and half as much again
    during that, with the depth that fits."""
    codes, levels = leaves.codes.long(), levels_of(leaves.codes.long())
    device, deepest = codes.device, int(levels.max()) if len(codes) else 1
    free, nodes, fits = free_on(device), 0, 0
    for level in range(min(depth or deepest, deepest)):
        below = levels > level
        nodes += len(torch.unique(codes[below] >> 3 * (levels[below] - level)))
        needed = nodes * 8 * 4 * (2 + 3 * leaves.basis) * 3 // 2
        fits = level + 1 if needed <= free else fits
    if fits < min(depth or deepest, deepest):
        less = f"give --depth {fits}, which fits" if fits else "end other programs"
        raise LumigraphError(
            f"An octree of depth {depth or deepest} has {nodes:,} nodes and would need {gigabytes(needed)} of memory, "
            f"and {gigabytes(free)} are free; {less}"
        )


Subtree = tuple[Tree, Tensor, Tensor]  # a tree for some rows, and those rows of density and harmonics


def places_of(codes: Int[Tensor, " row"], levels: Int[Tensor, " row"]) -> Int[Tensor, "row 3"]:
    """Whole-number coordinates of cells in their level."""
    place = torch.zeros(len(codes), 3, dtype=torch.int64, device=codes.device)
    for k in range(int(levels.max()) if len(levels) else 0):
        bits = torch.stack([codes >> 3 * k + 2, codes >> 3 * k + 1, codes >> 3 * k], -1) & 1
        place += torch.where((k < levels)[:, None], bits << k, 0)
    return place


def in_space(codes: Int[Tensor, " row"]) -> Int[Tensor, " row"]:
    """Order of cells of any levels along the Morton curve (Morton 1966)."""
    levels = levels_of(codes)
    return (codes << 3 * (levels.max() - levels if len(levels) else levels)).argsort()


def codes_of(place: Int[Tensor, "row 3"], depth: int) -> Int[Tensor, " row"]:
    """Codes of cells of one level, from their whole numbers along each axis."""
    x, y, z = place.unbind(-1)
    return code_of(x, y, z, depth)


class LeafSampler(Sampler):
    """Samples at the leaves of an octree, from near to far until rays terminate.

    near:          distance from a camera at which its rays begin
    stop:          transmittance at which a ray terminates
    rays_per_step: rays of a step
    """

    rays_per_chunk = 1 << 18

    def __init__(self, near: float, stop: float, rays_per_step: int):
        super().__init__()
        self.near, self.stop = near, stop
        self.batch_size = self.expected_rays = rays_per_step

    def sample(  # type: ignore[override]
        self, rays: Rays, field: Leaves, code: RayCodes | None = None, generator: torch.Generator | None = None
    ) -> list[Pass]:
        found = field.crossed(rays, self.near, self.stop)
        density = field.densities[found.rows, 0].relu()
        directions = rays.directions[found.samples.ray_index]
        return [Pass("leaves", found.samples, density, field.harmonics[found.rows], directions)]
