"""Baked fields: Octree, harmonics in cells of several sizes; Atlas, a sparse grid of diffuse colours and features; and
the binary data of both for web/src/volumes.js. `write_octree` writes the .npz format of PlenOctrees' viewers (Yu 2021;
volrend, svox)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import max_pool3d

from ..datasets.scene import Frame
from ..files import replacing
from ..geometry import Similarity


@dataclass(frozen=True)
class ViewNetwork:
    """Network that adds the view-dependent colour to a pixel's diffuse one (section 4.2): three layers, ReLU between
    them, a sigmoid at the end. Inputs: direction encoded at four frequencies (27), diffuse colour (3), features (4).

        colour = diffuse + (1 - opacity) background + opacity network(gamma(d), diffuse, features)
        gamma(d) = (d, sin d, sin 2d, sin 4d, sin 8d, cos d, cos 2d, cos 4d, cos 8d), each x, y, z

    d is the ray's unit direction in the scene's frame; diffuse, features and opacity are summed along the ray, nothing
    behind them: s_0 = 0, T_0 = 1, s_i = s_(i-1) + T_(i-1) v_i, T_i = T_(i-1) (1 - alpha_i), one voxel a step.
    """

    weights: tuple[Float[Tensor, "in out"], Float[Tensor, "in2 out2"], Float[Tensor, "in3 3"]]
    biases: tuple[Float[Tensor, " out"], Float[Tensor, " out2"], Float[Tensor, " 3"]]


@dataclass(frozen=True)
class Atlas:
    """Voxels in blocks (Hedman 2021, arXiv 2103.14645): `index` has the position of each block of the whole grid in the
    atlas, −1 for empty ones.

    index:    block's number in the atlas, for each block of the grid (x, y, z)
    values:   of each voxel of each block with an apron of one voxel: red, green, blue, alpha, four features, all in
              256 steps. Colours and features are premultiplied by alpha = 1 − exp(−density · voxel)
    low:      corner of the grid, in the scene's frame
    voxel:    side of a voxel, in scene units
    block:    voxels along a block's side, without the apron
    network:  None for an atlas of diffuse colours alone
    contracted: whether the grid is the cube of [-2, 2]^3 of an open capture: points x beyond the unit ball lie at
              (2 - 1 / |x|) x / |x| in it (Barron 2022, eq. 10), a step is a voxel long there, and alpha is that of a
              radial ray
    """

    index: Int[Tensor, "x y z"]
    values: UInt8[Tensor, "block side side side 8"]
    low: Float[Tensor, " 3"]
    voxel: float
    block: int
    network: ViewNetwork | None = None
    contracted: bool = False

    def voxels(self) -> tuple[Int[Tensor, "voxel 3"], UInt8[Tensor, "voxel 8"]]:
        """Grid coordinates of the occupied voxels, and their values."""
        inner = self.values[:, 1:-1, 1:-1, 1:-1]
        number, *inside = inner.any(-1).nonzero().unbind(-1)
        there = (self.index >= 0).nonzero()
        corner = torch.zeros(len(inner), 3, dtype=torch.int64)
        corner[self.index[tuple(there.unbind(-1))].long()] = there
        return corner[number] * self.block + torch.stack(inside, -1), inner[number, *inside]


@dataclass(frozen=True)
class Octree:
    """An octree (Yu 2021, arXiv 2103.14024, section 4). Values are constant inside a cell.

    child:     for each of a node's eight cells (x, y, z), 0 for a leaf, else the offset to its node
    density:   per scene unit, of each cell
    harmonics: coefficients of each cell; the colour along a direction is sigmoid(Σ coefficient · basis), sRGB-encoded
    low, size: the cube's corner and side, in the scene's frame
    """

    child: Int[Tensor, "node 2 2 2"]
    density: Float[Tensor, "node 2 2 2"]
    harmonics: Float[Tensor, "node 2 2 2 basis 3"]
    low: Float[Tensor, " 3"]
    size: float


EMPTY, LEAF, DIVIDED = 0, 1, 2
ENTRY_LEVEL = 6  # of an octree: rays look cells of that level up at once and descend from there
MIN_VOXELS, MAX_CELLS = 4, 128  # of an atlas: voxels along a cell of empty space at least, cells along an axis at most
MAX_LEAP_CELLS = 63  # cells that a ray leaps at most
FLOAT16_MAX = 65504.0  # the largest number that half precision has


@dataclass(frozen=True)
class Browsable:
    """Binary data of a web page.

    settings: JSON
    data:     little-endian, not compressed
    degree:   of harmonics; fewer take less
    """

    settings: dict[str, Any]
    data: bytes
    degree: int = 0


def octree_for_browser(octree: Octree, degree: int = 3) -> Browsable:
    """An octree without empty cells: density in 16 bits, harmonics in 8 bits times one 16-bit scale for each leaf.

    degree: highest degree of harmonics to keep
    The data: density and scale of every leaf (16 bits each), the kind of every cell, the distance of every cell of the
    entry level to the nearest occupied one, and the bytes of all leaves, coefficient by coefficient. Nodes come level
    by level, and so do leaves, so that a cell's child is the number of cells of its kind before it.
    """
    kinds, cells, levels = breadth_first(octree)
    level = min(ENTRY_LEVEL, levels)
    leaves = cells[kinds == LEAF]
    kept = min(octree.harmonics.shape[-2], (degree + 1) ** 2)
    harmonics = octree.harmonics.detach().cpu().flatten(0, 3)[leaves, :kept].flatten(1).float()
    density = octree.density.detach().cpu().flatten()[leaves].float().clamp_max(FLOAT16_MAX).half()
    scale = harmonics.abs().amax(1).clamp(1e-4, FLOAT16_MAX).half()
    codes = (127 * harmonics / scale.float()[:, None]).round().clamp(-127, 127).add(128).to(torch.uint8)
    far = clearance(filled(octree, level))
    settings = {
        "volume": "octree",
        "low": octree.low.tolist(),
        "size": octree.size,
        "nodes": len(kinds) // 8,
        "leaves": len(leaves),
        "bases": kept,
        "level": level,
        "levels": levels,
    }
    return Browsable(settings, b"".join(map(raw, (density, scale, kinds, x_first(far), codes.T))), math.isqrt(kept) - 1)


def breadth_first(octree: Octree) -> tuple[UInt8[Tensor, " cell"], Tensor, int]:
    """Kind of each cell, its index among the octree's cells, and the number of levels; level by level."""
    child, solid = octree.child.cpu().long().flatten(1), octree.density.detach().cpu().flatten(1) > 0
    nodes, kinds, cells = torch.zeros(1, dtype=torch.long), [], []
    while len(nodes):
        below = child[nodes]
        kinds.append((DIVIDED * (below != 0) + LEAF * ((below == 0) & solid[nodes])).to(torch.uint8).flatten())
        cells.append((8 * nodes[:, None] + torch.arange(8)).flatten())
        nodes = (nodes[:, None] + below)[below != 0]
    return torch.cat(kinds), torch.cat(cells), len(kinds)


def filled(octree: Octree, level: int) -> Bool[Tensor, "x y z"]:
    """Mask of a level's cells that are occupied, or part of a larger occupied one."""
    child, solid = octree.child.cpu().long(), octree.density.detach().cpu() > 0
    nodes, corners = torch.zeros(1, dtype=torch.long), torch.zeros(1, 3, dtype=torch.long)
    grid = torch.zeros((2**level,) * 3, dtype=torch.bool)
    offsets = torch.cartesian_prod(*[torch.arange(2)] * 3)
    for above in range(level):
        below = child[nodes].flatten(1)
        places = 2 * corners[:, None] + offsets
        side = 2 ** (level - above - 1)
        for x, y, z in (places[(below == 0) & solid[nodes].flatten(1)] * side).tolist():
            grid[x : x + side, y : y + side, z : z + side] = True
        nodes, corners = (nodes[:, None] + below)[below != 0], places[below != 0]
    grid[tuple(corners.T)] = True
    return grid


def atlas_for_browser(atlas: Atlas) -> Browsable:
    """An atlas with the distances of its empty space.

    The data: the number of the block at each position of the grid (32 bits), the distance of each cell of some voxels
    to the nearest occupied one, and the bytes of all blocks, channel by channel: three colours, alpha, and with a
    network the features.
    """
    cell = max(MIN_VOXELS, -(-atlas.block * max(atlas.index.shape) // MAX_CELLS))
    far = clearance(touched(atlas, cell))
    values = atlas.values.cpu()[..., : 8 if atlas.network else 4]
    settings = {
        "volume": "atlas",
        "low": atlas.low.tolist(),
        "voxel": atlas.voxel,
        "block": atlas.block,
        "grid": list(atlas.index.shape),
        "blocks": len(values),
        "channels": values.shape[-1],
        "cell": cell,
        "cells": list(far.shape),
        "network": plain(atlas.network) if atlas.network else None,
        "contracted": atlas.contracted,
    }
    index, blocks = x_first(atlas.index.cpu().int()), values.permute(4, 0, 3, 2, 1)
    return Browsable(settings, b"".join(map(raw, (index, x_first(far), blocks))))


def touched(atlas: Atlas, cell: int) -> Bool[Tensor, "x y z"]:
    """Mask of cells of `cell` voxels in which trilinear lookups are not zero."""
    block, grid = atlas.block, torch.tensor(atlas.index.shape)
    shape = (-(-block * grid // cell)).tolist()
    found = torch.zeros(shape, dtype=torch.bool)
    for corner in (atlas.index >= 0).nonzero():
        values = atlas.values[atlas.index[tuple(corner)]].cpu()
        # A place between two voxels' centres takes from both, so what a voxel holds reaches the voxels around it.
        reached = max_pool3d((values != 0).any(-1)[None].float(), 3, 1)[0].bool()
        voxels = (reached.nonzero() + block * corner.cpu()) // cell
        found[tuple(voxels.T)] = True
    return found


def clearance(occupied: Bool[Tensor, "x y z"]) -> UInt8[Tensor, "x y z"]:
    """Chebyshev distance of each cell to the nearest occupied one, 0 there; MAX_LEAP_CELLS at most."""
    grown, far = occupied[None].float(), torch.zeros(occupied.shape, dtype=torch.uint8)
    for _ in range(MAX_LEAP_CELLS):
        if grown.all():
            break
        far += (grown[0] == 0).to(torch.uint8)
        for kernel in ((3, 1, 1), (1, 3, 1), (1, 1, 3)):
            grown = max_pool3d(grown, kernel, 1, tuple(k // 2 for k in kernel))
    return far


def plain(network: ViewNetwork) -> list[dict[str, Any]]:
    """Weights and biases of each layer, one row for each input."""
    layers = zip(network.weights, network.biases, strict=True)
    return [{"weights": rounded(weights), "biases": rounded(biases)} for weights, biases in layers]


def rounded(values: Tensor) -> Any:
    return np.round(values.detach().cpu().double().numpy(), 6).tolist()


def x_first(grid: Tensor) -> Tensor:
    """Grid [x, y, z] in memory order with x fastest, as graphics APIs need it."""
    return grid.permute(2, 1, 0)


def raw(values: Tensor) -> bytes:
    return values.contiguous().numpy().tobytes()


ROTATION_TOLERANCE = 1e-4  # of a rotation's entries, below which there is none


def write_octree(path: Path, octree: Octree, frame: Frame) -> bool:
    """Write the .npz file. Returns True if it is in the frame of the photographs.

    A point p is at p · invradius3 + offset in the unit cube. The format has no rotation: where the scene's frame is
    rotated against that of the photographs, the octree stays in the scene's.
    """
    straight = (frame.to_source.rotation - torch.eye(3, dtype=torch.float64)).abs().max() < ROTATION_TOLERANCE
    arrays = contents(octree, frame.to_export if straight else Similarity.make(1.0))
    with replacing(path, "octree") as new, open(new, "wb") as file:
        np.savez_compressed(file, **arrays)
    return bool(straight)


def contents(octree: Octree, moved: Similarity) -> dict[str, Any]:
    """Arrays of the file by name. moved: similarity to the file's frame, without rotation

    data: of each cell, all coefficients of red, of green, of blue, then density per unit of the file's frame
    """
    nodes, basis = len(octree.child), octree.harmonics.shape[-2]
    scale = moved.scale
    corner, size = moved.points(octree.low.double().cpu()).numpy(), octree.size * scale
    colours = octree.harmonics.transpose(-1, -2).flatten(-2).half().cpu().numpy()
    density = (octree.density / scale).clamp(0, FLOAT16_MAX).half().cpu().numpy()
    child = octree.child.int().cpu().numpy()
    return {
        "data_dim": np.int64(3 * basis + 1),
        "data_format": np.array(f"SH{basis}"),
        "invradius3": np.full(3, 1 / size, np.float32),
        "offset": (-corner / size).astype(np.float32),
        "child": child,
        "data": np.concatenate([colours, density[..., None]], -1),
        "parent_depth": parents(child),  # this and what follows is svox's
        "n_internal": np.int64(nodes),
        "n_free": np.int64(0),
        "depth_limit": np.int64(10),
        "geom_resize_fact": np.float64(1.0),
    }


def parents(child: np.ndarray) -> np.ndarray:
    """Parent cell of each node as 8 node + place, and its depth, (node, 2) int32."""
    found = np.zeros((len(child), 2), np.int32)
    divided = np.flatnonzero(child)
    below = divided // 8 + child.reshape(-1)[divided]
    found[below, 0] = divided
    for cell, node in zip(divided.tolist(), below.tolist(), strict=True):  # a node stands ahead of those below it
        found[node, 1] = found[cell // 8, 1] + 1
    return found
