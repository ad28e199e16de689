"""Voxel hashing (Nießner et al. 2013): depth maps fused into blocks of 8³ voxels, allocated near surfaces alone."""

import math
from typing import ClassVar

import torch
from jaxtyping import Float, Int, Int32
from torch import Tensor, nn
from torch.nn.functional import max_pool2d

from .. import kernels
from ..camera.rays import Rays
from ..kernels.block_hash import SIDE, VOXELS, new_table
from ..kernels.fuse_depth import CHANNELS, empty_voxels
from .depth_map import DepthMap
from .pinholes import pinhole_maps

GROWTH = 2.0  # times the blocks that memory is taken for, when it is used up; what is not yet touched costs nothing
FIRST_BLOCKS = 4096  # that memory is taken for at first
PIXELS_PER_SIDE, MAX_PIXEL_STEP = 4, 4  # pixels that ask for blocks to a side of a block; beyond which none are skipped
MAX_LOAD = 0.5  # blocks to a slot of the table
EDGE = 0.08  # of the least depth of four neighbouring pixels, from which on they show two surfaces
EMPTY_DISTANCE = 0.9  # of the truncation: a block without a voxel nearer to a surface shows none
BYTES_PER_BLOCK = VOXELS * CHANNELS * 4 + 12


class VoxelBlocks(nn.Module):
    """Sparse truncated signed distance field with colours.

    blocks: coordinates of the blocks: voxel (i, j, k) of block b lies at edge (8 b + (i, j, k))
    voxels: distance over truncation (positive in front of surfaces), weight, sRGB-encoded colour of each block's voxels
    table:  the hash table of the blocks
    """

    grows: ClassVar[tuple[str, ...]] = ("blocks", "voxels")
    blocks: Int32[Tensor, "block 3"]
    voxels: Float[Tensor, "block 512 5"]
    table: Int32[Tensor, " slot"]

    def __init__(
        self,
        edge: float,
        truncation: float,
        max_weight: float = math.inf,
        max_blocks: int = 1 << 24,
        growth: float = 0.0,
    ):
        """Create an empty field. edge: of a voxel, scene units; truncation: in voxels; max_blocks: limit; growth: of
        the truncation, for each unit of depth"""
        super().__init__()
        self.growth = growth
        self.edge, self.truncation, self.max_weight, self.max_blocks = edge, truncation * edge, max_weight, max_blocks
        self.register_buffer("blocks", torch.empty(0, 3, dtype=torch.int32))
        self.register_buffer("voxels", empty_voxels(0))
        self.register_buffer("table", new_table(self.blocks), persistent=False)
        self.register_load_state_dict_post_hook(lambda module, _: module.rehash())

    def __len__(self) -> int:
        return len(self.blocks)

    @property
    def bytes(self) -> int:
        """Memory of the voxels and of the table."""
        return len(self) * BYTES_PER_BLOCK + 4 * len(self.table)

    def rehash(self) -> None:
        self.table = new_table(self.blocks)

    @torch.no_grad()
    def fuse(self, seen: DepthMap, trust: Float[Tensor, "height width"]) -> bool:
        """Integrate one depth map with weights `trust`. False if no memory is left for new blocks."""
        room = True
        for part in pinhole_maps(seen, trust):
            given = (x.to(self.voxels.device) for x in (part.depth, part.rgb, part.trust, part.pose, part.lens))
            depth, rgb, trusted, pose, lens = (x.contiguous() for x in given)
            depth = torch.where(trusted > 0, depth, torch.nan)
            room = self._add(self._new_blocks(depth, pose, lens)) and room
            numbers = self.edge, self.truncation, EDGE, self.max_weight, self.growth
            kernels.fuse_depth(self.voxels, self.blocks, depth, rgb, trusted, pose, lens, *numbers, in_place=True)
        return room

    def _new_blocks(
        self, depth: Float[Tensor, "height width"], pose: Float[Tensor, "3 4"], lens: Float[Tensor, " 4"]
    ) -> Int32[Tensor, "new 3"]:
        """Missing blocks around surfaces: by rays of pixels, PIXELS_PER_SIDE to a block's side at median depth. A pixel
        stands for a square of them: the nearest one where it is unknown itself, so that no pattern of holes hides all.
        """
        side, known = SIDE * self.edge, depth[(depth > 0) & (depth < math.inf)][::64]
        typical, farthest = (float(known.median()), float(known.amax())) if known.numel() else (0.0, 0.0)
        step = int(side * float(lens[:2].min()) / max(PIXELS_PER_SIDE * typical, 1e-9))
        step = min(max(step, 1), MAX_PIXEL_STEP)
        some, numbers = depth[::step, ::step].contiguous(), lens / step
        if step > 1 and (unknown := ~((some > 0) & (some < math.inf))).any():
            there = torch.where(depth > 0, -depth, -math.inf)[None]
            some = torch.where(unknown, -max_pool2d(there, step, ceil_mode=True)[0], some)
        band = self.truncation + self.growth * farthest
        numbers[2:] += 0.5 - 0.5 / step  # centres of pixels stay where they are
        return kernels.band_blocks(some, pose, numbers, self.blocks, self.table, side, band)

    def _add(self, new: Int32[Tensor, "new 3"]) -> bool:
        """Append blocks without observations; False if there is no memory for them."""
        first, count = len(self), len(self) + len(new)
        if count > self.max_blocks:
            return False
        if len(new):
            self.blocks = _extended(self.blocks, count, new)
            self.voxels = _extended(self.voxels, count, empty_voxels(1, new.device))
            if count > MAX_LOAD * len(self.table):
                self.rehash()
            else:
                self.table = kernels.block_hash(self.blocks, self.table, first)
        return True

    @torch.no_grad()
    def prune(self) -> int:
        """Remove blocks without a voxel near a surface (Nießner 2013, sec. 4.3); returns their number."""
        near = (self.voxels[..., 1] > 0) & (self.voxels[..., 0].abs() < EMPTY_DISTANCE)
        kept = near.any(-1)
        removed = len(self) - int(kept.sum())
        if removed:
            self.blocks, self.voxels = self.blocks[kept], self.voxels[kept]
            self.rehash()
        return removed

    def bounds(self) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
        """Lowest and highest corner of all blocks."""
        low, high = self.blocks.amin(0), self.blocks.amax(0) + 1
        return SIDE * self.edge * low, SIDE * self.edge * high

    @torch.no_grad()
    def cast(
        self, rays: Rays, step: float = 1.0
    ) -> tuple[Float[Tensor, " ray"], Float[Tensor, "ray 3"], Float[Tensor, "ray 3"]]:
        """Distance, normal and colour of the first surface along each ray; infinity without one.

        step: step length along a ray, in voxels
        """
        near = torch.zeros_like(rays.radius)
        far = near.clone()
        if len(self):
            enter, leave = rays.through_box(torch.stack(self.bounds()))
            near, far = enter.clamp_min(0), leave
        given = self.voxels, self.blocks, self.table, self.edge, step * self.edge
        return kernels.cast_blocks(rays.origins, rays.directions, near, far, *given)

    @torch.no_grad()
    def surface(
        self, min_weight: float = 0.0
    ) -> tuple[Float[Tensor, "vertex 3"], Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
        """Vertices in the scene's frame, their colours, and triangles, anticlockwise seen from in front.

        min_weight: of a valid voxel; above the weight of one depth map, surfaces seen once are lost
        """
        places, rgb, faces = kernels.block_surface(self.voxels, self.blocks, self.table, min_weight)
        return self.edge * places, rgb, faces


def _extended(rows: Tensor, count: int, new: Tensor) -> Tensor:
    """Rows resized to `count`, within the same memory while its capacity lasts.

    new: value of the new rows, broadcast to their shape
    """
    held, size = len(rows), math.prod(rows.shape[1:]) * rows.element_size()
    if rows.untyped_storage().nbytes() < count * size or rows.storage_offset():
        shape = max(count, FIRST_BLOCKS, int(GROWTH * held)), *rows.shape[1:]
        larger = rows.new_empty(shape)
        larger[:held] = rows
        rows = larger
    grown = rows.new_empty(0).set_(rows.untyped_storage(), 0, (count, *rows.shape[1:]))  # type: ignore[call-overload]
    grown[held:] = new
    return grown
