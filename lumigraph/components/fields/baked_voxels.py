"""Baked voxels: alpha, diffuse colour and features at those voxels of a grid that hold something and are seen."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from ... import kernels
from ...baked import Atlas
from ...kernels.block_march import ALPHA, CHANNELS
from ...rays import Rays, Samples
from ...volume import packed
from .deferred import ViewDependence

STEPS = 255  # between the least and the largest of a value that is told by eight bits
OPAQUE = 1 - 1e-6
FEW = 1 << 10  # rays whose steps are all looked at together


class BakedVoxels(nn.Module):
    """Voxels of a grid, in any order.

    places:    of each voxel in the grid
    levels:    of each voxel red, green, blue, alpha and four features, all but alpha multiplied by alpha, in 256 steps
    low, edge: corner of the grid and side of a voxel, in the scene's frame
    size:      voxels along each axis
    """

    grows: ClassVar[tuple[str, ...]] = ("places", "levels")
    places: Tensor
    levels: Tensor
    low: Tensor
    edge: Tensor
    size: Tensor

    def __init__(self, block: int):
        super().__init__()
        self.block = block
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
        """Other voxels, of which nothing is known yet."""
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
        """What eight bits tell."""
        return self._known[1]

    @property
    def _known(self) -> tuple[kernels.Blocks, Tensor]:
        """Blocks and values, made when they are asked for."""
        of = self.places, self.places._version, self.levels, self.levels._version
        if self._made is None or any(a is not b for a, b in zip(self._made[0], of, strict=True)):
            x, y, z = self.size.tolist()
            self._made = of, kernels.Blocks.of(self.places.long(), (x, y, z), self.block), self.levels.float() / STEPS
        return self._made[1:]

    @property
    def box(self) -> Float[Tensor, "2 3"]:
        """The grid's corners, in the scene's frame; it is made of whole blocks, as its atlas is."""
        whole = (self.size + self.block - 1) // self.block * self.block
        return torch.stack([self.low, self.low + self.edge * whole])

    def march(
        self, rays: Rays, values: Float[Tensor, "voxel 8"], near: float, stop: float
    ) -> tuple[Float[Tensor, "ray 8"], Float[Tensor, " ray"]]:
        """What lies along rays, one voxel a step, accumulated front to back; and opacity times distance, in scene
        units. near, stop: as of `kernels.block_march`, near in scene units"""
        totals, distance = kernels.block_march(*self._along(rays, near), self.blocks, values, stop)
        return totals, distance * self.edge

    def at(self, points: Float[Tensor, "point 3"], values: Float[Tensor, "voxel 8"]) -> Float[Tensor, "point 8"]:
        """What is blended at points of the scene; nothing beyond the grid. A march of one step finds it."""
        zeros = points.new_zeros(len(points))
        ahead = points.new_tensor([0.0, 0.0, 1.0]).expand(len(points), 3)
        return kernels.block_march(self._in_voxels(points), ahead, zeros, zeros + 0.5, self.blocks, values)[0]

    def samples(
        self, rays: Rays, values: Float[Tensor, "voxel 8"], near: float
    ) -> tuple[Samples, Float[Tensor, "sample 8"]]:
        """The steps of rays that meet something, each a voxel long, with what they meet."""
        starts, counts, found = [], [], []
        for first in range(0, len(rays), FEW):
            origins, directions, enter, leave = self._along(rays[first : first + FEW], near)
            steps = torch.arange(int((leave - enter).ceil().clamp_min(0).amax()), device=enter.device)
            t = enter[:, None] + steps
            points = origins[:, None] + t[..., None] * directions[:, None]
            own = ((points + 0.5) / self.block).floor().long()
            blocks = torch.tensor(self.blocks.index.shape, device=own.device)
            inside = (t < leave[:, None]) & ((own >= 0) & (own < blocks)).all(-1)
            x, y, z = torch.where(inside[..., None], own, 0).unbind(-1)
            inside &= self.blocks.index[x, y, z] >= 0
            seen = self.at(points[inside] * self.edge + (self.low + 0.5 * self.edge), values)
            full = seen[:, ALPHA] > 0
            inside[inside.clone()] = full
            starts.append(t[inside])
            counts.append(inside.sum(-1))
            found.append(seen[full])
        middle = torch.cat(starts) if starts else rays.radius[:0]
        each = torch.cat(counts) if counts else torch.zeros(0, dtype=torch.int64, device=rays.radius.device)
        samples = Samples((middle - 0.5) * self.edge, (middle + 0.5) * self.edge, packed(each))
        return samples, torch.cat(found) if found else values[:0]

    def density(self, alpha: Float[Tensor, " point"]) -> Float[Tensor, " point"]:
        """Per scene unit, of what has an alpha over one voxel: alpha = 1 - exp(-density edge)."""
        return -torch.log1p(-alpha.clamp(0, OPAQUE)) / self.edge

    def atlas(self, levels: UInt8[Tensor, "voxel 8"], view: ViewDependence | None) -> Atlas:
        """All of it for browsers and files."""
        rows = self.blocks.rows.long()
        table = torch.cat([levels, levels.new_zeros(1, CHANNELS)])
        values = table[torch.where(rows >= 0, rows, len(levels))]
        network = None if view is None else view.baked()
        index, low, edge = self.blocks.index.long().cpu(), self.low.cpu(), float(self.edge)
        return Atlas(index, values.cpu(), low, edge, self.block, network)

    def _in_voxels(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Points of the scene where the centre of voxel (x, y, z) is (x, y, z)."""
        return (points - self.low) / self.edge - 0.5

    def _along(self, rays: Rays, near: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Rays in voxels, the first step half a voxel behind where they enter the grid."""
        enter, leave = (t / self.edge for t in rays.through_box(self.box))
        enter = enter.clamp_min(near / float(self.edge)) + 0.5
        return self._in_voxels(rays.origins), rays.directions, enter, torch.maximum(leave, enter - 1)


def rounded(values: Float[Tensor, "voxel 8"]) -> UInt8[Tensor, "voxel 8"]:
    """Values in [0, 1] in 256 steps."""
    return (values.clamp(0, 1) * STEPS).round().to(torch.uint8)
