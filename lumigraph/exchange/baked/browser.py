"""Octrees and atlases as a browser's graphics take them: a few numbers, and bytes that web/src/volumes.js reads."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from torch import Tensor
from torch.nn.functional import max_pool3d

from .atlas import Atlas, ViewNetwork
from .octree import Octree

EMPTY, LEAF, DIVIDED = 0, 1, 2
ENTRY_LEVEL = 6  # of an octree: rays look cells of that level up at once and descend from there
MIN_VOXELS, MAX_CELLS = 4, 128  # of an atlas: voxels along a cell of empty space at least, cells along an axis at most
MAX_LEAP_CELLS = 63  # cells that a ray leaps at most
FLOAT16_MAX = 65504.0  # the largest number that half precision has


@dataclass(frozen=True)
class Browsable:
    """Data of a page.

    settings: what JSON can hold
    data:     little-endian, not compressed
    degree:   of harmonics, of which fewer would take less
    """

    settings: dict[str, Any]
    data: bytes
    degree: int = 0


def octree_for_browser(octree: Octree, degree: int = 3) -> Browsable:
    """An octree without what is empty: density in 16 bits, harmonics in 8 bits times one 16-bit scale for each leaf.

    degree: highest of the harmonics that is kept
    The data: density and scale of every leaf (16 bits each), the kind of every cell, how far from every cell of the
    entry level the nearest that is not empty lies, and each coefficient's bytes of all leaves after another's. Nodes
    come level by level, and so do leaves, so that where a cell leads to is how many of its kind came before.
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
    """The kind of each cell, its place among all cells of the octree, and how many levels there are; level by level."""
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
    """An atlas, and how far its empty space reaches.

    The data: the number of the block at each place of the grid (32 bits), how far from each cell of some voxels the
    nearest that is not empty lies, and each channel's bytes of all blocks after another's: three colours, alpha, and
    with a network the features.
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
    """Mask of cells of so many voxels in which trilinear lookups find anything."""
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
    """Chessboard distance of each cell to the nearest that is occupied, 0 there; MAX_LEAP_CELLS at most."""
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
