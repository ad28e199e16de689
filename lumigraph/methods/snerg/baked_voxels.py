"""Baked voxels: alpha, diffuse colour and features at the occupied, visible voxels of a grid."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn
from torch.nn.functional import avg_pool3d, max_pool3d

from ... import kernels
from ...camera.rays import Rays, Samples
from ...components.fields.spaces import Contraction
from ...exchange.baked import Atlas
from ...kernels.block_march import ALPHA, CHANNELS
from ...kernels.block_march.reference import contracted, steps
from ...method import Part
from ...volume import packed
from .deferred_field import ViewDependence

STEPS = 255  # between the least and the largest of a value that is told by eight bits
OPAQUE = 1 - 1e-6
FEW = 1 << 10  # rays whose steps are all looked at together


class BakedVoxels(nn.Module):
    """Voxels of a grid, in any order.

    places:    of each voxel in the grid
    levels:    of each voxel red, green, blue, alpha and four features, all but alpha multiplied by alpha, in 256 steps
    low, edge: corner of the grid and side of a voxel, in the scene's frame
    size:      voxels along each axis

    With a space the grid is [-2, 2]^3, and holds an open capture in twice the coordinates of that contraction, which
    inside the unit ball are the scene's own (Reiser 2023, section 4.1, has a similar one). Elsewhere a voxel's length
    in the scene is that along the way out.
    """

    grows: ClassVar[tuple[str, ...]] = ("places", "levels")
    places: Tensor
    levels: Tensor
    low: Tensor
    edge: Tensor
    size: Tensor

    def __init__(self, block: int, space: Contraction | None = None):
        super().__init__()
        self.block, self.space = block, space
        self.register_buffer("places", torch.zeros(0, 3, dtype=torch.int16))
        self.register_buffer("levels", torch.zeros(0, CHANNELS, dtype=torch.uint8))
        self.register_buffer("low", torch.full((3,), -1.0))
        self.register_buffer("edge", torch.tensor(2.0))
        self.register_buffer("size", torch.ones(3, dtype=torch.int64))
        self._made: tuple[tuple[Tensor, int, Tensor, int], kernels.Blocks, Tensor] | None = None

    def __len__(self) -> int:
        return len(self.places)

    def hold(
        self, places: Int[Tensor, "voxel 3"], low: Float[Tensor, " 3"], edge: float, size: Int[Tensor, " 3"]
    ) -> None:
        """Replace the voxels, with empty values."""
        self.places, self.levels = places.short(), places.new_zeros(len(places), CHANNELS, dtype=torch.uint8)
        self.low, self.edge, self.size = low.float(), torch.tensor(edge, device=low.device), size.long()

    def settle(self, values: Float[Tensor, "voxel 8"]) -> None:
        """Round values in [0, 1] to eight bits."""
        self.levels = rounded(values)

    @property
    def blocks(self) -> kernels.Blocks:
        return self._known[0]

    @property
    def values(self) -> Float[Tensor, "voxel 8"]:
        """Values of eight bits."""
        return self._known[1]

    @property
    def _known(self) -> tuple[kernels.Blocks, Tensor]:
        """Blocks and values, built on first use."""
        of = self.places, self.places._version, self.levels, self.levels._version
        if self._made is None or any(a is not b for a, b in zip(self._made[0], of, strict=True)):
            x, y, z = self.size.tolist()
            blocks = kernels.Blocks.of(self.places.long(), (x, y, z), self.block, self.space is not None)
            self._made = of, blocks, self.levels.float() / STEPS
        return self._made[1:]

    @property
    def box(self) -> Float[Tensor, "2 3"]:
        """The grid's corners, in the scene's frame; it is made of whole blocks, as its atlas is."""
        whole = (self.size + self.block - 1) // self.block * self.block
        return torch.stack([self.low, self.low + self.edge * whole])

    def march(
        self, rays: Rays, values: Float[Tensor, "voxel 8"], near: float, stop: float
    ) -> tuple[Float[Tensor, "ray 8"], Float[Tensor, " ray"]]:
        """Values along rays, one voxel a step, accumulated front to back; and opacity times distance, in scene
        units. near, stop: as of `kernels.block_march`, near in scene units"""
        totals, distance = kernels.block_march(*self._along(rays, near), self.blocks, values, stop)
        return totals, distance * self.edge

    def at(self, points: Float[Tensor, "point 3"], values: Float[Tensor, "voxel 8"]) -> Float[Tensor, "point 8"]:
        """Interpolated values at points of the scene, by a march of one step; zero beyond the grid."""
        zeros = points.new_zeros(len(points))
        ahead = points.new_tensor([0.0, 0.0, 1.0]).expand(len(points), 3)
        return kernels.block_march(self._in_voxels(points), ahead, zeros, zeros + 0.5, self.blocks, values)[0]

    def samples(
        self, rays: Rays, values: Float[Tensor, "voxel 8"], near: float
    ) -> tuple[Samples, Float[Tensor, "sample 8"]]:
        """Non-empty steps of rays, each a voxel long, with their values."""
        starts, ends, counts, found = [], [], [], []
        for first in range(0, len(rays), FEW):
            origins, directions, enter, leave = self._along(rays[first : first + FEW], near)
            t = steps(origins, directions, enter, leave, self.blocks.ball)
            points = origins[:, None] + t[..., None] * directions[:, None]
            own = ((contracted(points, self.blocks.ball) + 0.5) / self.block).floor().long()
            blocks = torch.tensor(self.blocks.index.shape, device=own.device)
            inside = (t < leave[:, None]) & ((own >= 0) & (own < blocks)).all(-1)
            x, y, z = torch.where(inside[..., None], own, 0).unbind(-1)
            inside &= self.blocks.index[x, y, z] >= 0
            seen = self.at(points[inside] * self.edge + (self.low + 0.5 * self.edge), values)
            full = seen[:, ALPHA] > 0
            inside[inside.clone()] = full
            half = torch.nn.functional.pad(0.5 * t.diff(), (0, 1), value=0.5)  # of the way to the next step
            before = torch.cat([half[:, :1], half[:, :-1]], 1)
            starts.append((t - before)[inside])
            ends.append((t + half)[inside])
            counts.append(inside.sum(-1))
            found.append(seen[full])
        begin, end = (torch.cat(x) * self.edge if x else rays.radius[:0] for x in (starts, ends))
        each = torch.cat(counts) if counts else torch.zeros(0, dtype=torch.int64, device=rays.radius.device)
        samples = Samples(begin, end, packed(each))
        return samples, torch.cat(found) if found else values[:0]

    def length(self, points: Float[Tensor, "point 3"], edge: Tensor | float) -> Float[Tensor, " point"]:
        """Length of a voxel of this edge along the radial direction, in scene units."""
        radius = points.norm(dim=-1) if self.space else points.new_zeros(len(points))
        return edge * radius.clamp_min(1).square()

    @staticmethod
    def density(alpha: Float[Tensor, " point"], length: Float[Tensor, " point"]) -> Float[Tensor, " point"]:
        """Density per scene unit of an alpha over a length: alpha = 1 - exp(-density length)."""
        return -torch.log1p(-alpha.clamp(0, OPAQUE)) / length

    def atlas(self, levels: UInt8[Tensor, "voxel 8"], view: ViewDependence | None) -> Atlas:
        """The voxels as an atlas for browsers and files."""
        rows = self.blocks.rows.long()
        table = torch.cat([levels, levels.new_zeros(1, CHANNELS)])
        values = table[torch.where(rows >= 0, rows, len(levels))]
        network = None if view is None else view.baked()
        index, low, edge = self.blocks.index.long().clamp_min(-1).cpu(), self.low.cpu(), float(self.edge)
        return Atlas(index, values.cpu(), low, edge, self.block, network, self.space is not None)

    def _in_voxels(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Points of the scene where the centre of voxel (x, y, z) is (x, y, z)."""
        return (points - self.low) / self.edge - 0.5

    def _along(self, rays: Rays, near: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Rays in voxels, the first step half a voxel behind where they enter the grid."""
        bounds = self.space.interval(rays) if self.space else rays.through_box(self.box)
        enter, leave = (t / self.edge for t in bounds)
        enter = enter.clamp_min(near / float(self.edge)) + 0.5
        return self._in_voxels(rays.origins), rays.directions, enter, torch.maximum(leave, enter - 1)


def rounded(values: Float[Tensor, "voxel 8"]) -> UInt8[Tensor, "voxel 8"]:
    """Values in [0, 1] in 256 steps."""
    return (values.clamp(0, 1) * STEPS).round().to(torch.uint8)


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

    def before_step(self, method: object, step: int, progress: float) -> None:
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
        """Visible cells, dilated by one."""
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
