"""Level sets of numbers on a lattice as triangles: marching cubes of the voxel blocks, for blocks and whole grids."""

import numpy as np
import torch
from jaxtyping import Float, Int

from .. import kernels
from ..kernels.block_hash import SIDE, VOXELS, new_table

Triangles = tuple[Float[np.ndarray, "vertex 3"], Int[np.ndarray, "face 3"]]


def zero_level_of_blocks(
    values: Float[np.ndarray, "block side side side"], places: Int[np.ndarray, "block 3"]
) -> Triangles:
    """Triangles where values are zero, anticlockwise seen from where they are negative; vertices in lattice steps.

    values: of the corners of blocks, a multiple of SIDE along each side; NaN where unknown
    places: of blocks: corner (i, j, k) of block b lies at side b + (i, j, k)
    """
    times, known = values.shape[1] // SIDE, np.isfinite(values)
    inner = np.stack(np.meshgrid(*[np.arange(times)] * 3, indexing="ij"), -1).reshape(-1, 3)
    parts = np.stack([-np.where(known, values, 1.0), known], -1).astype(np.float32)
    parts = parts.reshape(len(values), *(times, SIDE) * 3, 2).transpose(0, 1, 3, 5, 2, 4, 6, 7)
    voxels = torch.from_numpy(np.ascontiguousarray(parts).reshape(-1, VOXELS, 2))
    blocks = torch.from_numpy((places[:, None] * times + inner).reshape(-1, 3).astype(np.int32))
    vertices, _, faces = kernels.block_surface(voxels, blocks, new_table(blocks), 0.5)
    return vertices.numpy().astype(np.float64), faces.numpy()


def zero_level_of_grid(values: Float[np.ndarray, "x y z"]) -> Triangles:
    """The same for all corners of a grid."""
    counts = [-(-n // SIDE) for n in values.shape]
    whole = np.full([SIDE * n for n in counts], np.nan, np.float32)
    whole[tuple(map(slice, values.shape))] = values
    x, y, z = counts
    blocks = whole.reshape(x, SIDE, y, SIDE, z, SIDE).transpose(0, 2, 4, 1, 3, 5).reshape(-1, SIDE, SIDE, SIDE)
    return zero_level_of_blocks(blocks, np.argwhere(np.ones(counts, bool)))
