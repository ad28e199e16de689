"""Numba: a task takes one block with the nearest voxels of its neighbours. The first pass counts and numbers vertices,
the second writes them and the faces."""

import numpy as np
import torch
from numba import njit, prange

from .._operation import empty
from ..block_hash import SIDE, VOXELS
from ..block_hash.cpu import find
from . import case_table

N, SIZE = SIDE, SIDE + 1
UNKNOWN, ZERO, ONE = np.float32(np.nan), np.float32(0), np.float32(1)


@njit(error_model="numpy")
def _fill(number, voxels, blocks, table, min_weight, near, d):
    """Load the distances of a block's voxels and its neighbours' first, NaN where unknown; True if the zero level is
    among them.

    near: numbers of the block itself and its neighbours
    """
    for c in range(8):
        near[c] = find(
            blocks[number, 0] + (c >> 2), blocks[number, 1] + ((c >> 1) & 1), blocks[number, 2] + (c & 1), blocks, table
        )
    below, above = False, False
    for i in range(SIZE):
        for j in range(SIZE):
            for k in range(SIZE):
                held = near[((i >> 3) << 2) | ((j >> 3) << 1) | (k >> 3)]
                d[i, j, k] = UNKNOWN
                if held >= 0:
                    row = ((i & 7) << 6) | ((j & 7) << 3) | (k & 7)
                    if voxels[held, row, 1] > min_weight:
                        d[i, j, k] = voxels[held, row, 0]
                        below |= d[i, j, k] < ZERO
                        above |= d[i, j, k] >= ZERO
    return below and above


@njit(inline="always", error_model="numpy")
def _crosses(a, b):
    return (a < ZERO and b >= ZERO) or (a >= ZERO and b < ZERO)


@njit(inline="always", error_model="numpy")
def _case(d, i, j, k):
    """Marching cubes case of a cube, 0 where one of its corners is unknown."""
    case, total = 0, ZERO
    for c in range(8):
        value = d[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
        total += value
        case |= (1 << c) if value < ZERO else 0
    return case if total == total else 0


@njit(parallel=True, cache=True, error_model="numpy")
def _count(voxels, blocks, table, min_weight, counts, packed, vertices, faces):
    """Count vertices and faces of each block. packed: of each voxel, number of vertices before it in its block, and a
    bit mask of its edges with a vertex."""
    for number in prange(len(blocks)):
        near, d = np.empty(8, np.int64), np.empty((SIZE, SIZE, SIZE), np.float32)
        vertices[number], faces[number] = 0, 0
        if not _fill(number, voxels, blocks, table, min_weight, near, d):
            packed[number, :] = 0
            continue
        total, triangles = 0, 0
        for i in range(N):
            for j in range(N):
                for k in range(N):
                    mask = 1 if _crosses(d[i, j, k], d[i + 1, j, k]) else 0
                    mask |= 2 if _crosses(d[i, j, k], d[i, j + 1, k]) else 0
                    mask |= 4 if _crosses(d[i, j, k], d[i, j, k + 1]) else 0
                    packed[number, (i << 6) | (j << 3) | k] = (total << 3) | mask
                    total += (mask & 1) + ((mask >> 1) & 1) + (mask >> 2)
                    triangles += counts[_case(d, i, j, k)]
        vertices[number], faces[number] = total, triangles


@njit(parallel=True, cache=True, error_model="numpy")
def _write(voxels, blocks, table, min_weight, fans, counts, packed, starts, face_starts, out, values, faces):
    for number in prange(len(blocks)):
        vertex, face = starts[number], face_starts[number]
        if vertex == starts[number + 1] and face == face_starts[number + 1]:
            continue
        near, d = np.empty(8, np.int64), np.empty((SIZE, SIZE, SIZE), np.float32)
        _fill(number, voxels, blocks, table, min_weight, near, d)
        for row in range(VOXELS):
            i, j, k = row >> 6, (row >> 3) & 7, row & 7
            for axis in range(3):
                if not (packed[number, row] >> axis) & 1:
                    continue
                a, b, c = i + (axis == 0), j + (axis == 1), k + (axis == 2)
                held = near[((a >> 3) << 2) | ((b >> 3) << 1) | (c >> 3)]
                other = ((a & 7) << 6) | ((b & 7) << 3) | (c & 7)
                share = d[i, j, k] / (d[i, j, k] - d[a, b, c])
                out[vertex, 0] = np.float32(SIDE * blocks[number, 0] + i) + (share if axis == 0 else ZERO)
                out[vertex, 1] = np.float32(SIDE * blocks[number, 1] + j) + (share if axis == 1 else ZERO)
                out[vertex, 2] = np.float32(SIDE * blocks[number, 2] + k) + (share if axis == 2 else ZERO)
                if values.shape[1]:
                    if voxels[number, row, 2] < ZERO:
                        share = ONE
                    elif voxels[held, other, 2] < ZERO:
                        share = ZERO
                for channel in range(values.shape[1]):
                    one, two = voxels[number, row, 2 + channel], voxels[held, other, 2 + channel]
                    values[vertex, channel] = one + share * (two - one)
                vertex += 1
            case = _case(d, i, j, k)
            for nth in range(counts[case]):
                for corner in range(3):
                    edge = fans[case, nth, corner]
                    c, axis = edge // 3, edge % 3
                    x, y, z = i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)
                    held = near[((x >> 3) << 2) | ((y >> 3) << 1) | (z >> 3)]
                    code = packed[held, ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)]
                    before = code & ((1 << axis) - 1)
                    faces[face, corner] = starts[held] + (code >> 3) + (before & 1) + (before >> 1)
                face += 1


def run(voxels, blocks, table, min_weight):
    given = *(x.detach().contiguous().numpy() for x in (voxels, blocks, table)), np.float32(min_weight)
    fans, counts = (x.numpy() for x in case_table())
    packed = np.empty((len(blocks), VOXELS), np.int32)
    starts, face_starts = (np.zeros(len(blocks) + 1, np.int64) for _ in range(2))
    _count(*given, counts, packed, starts[1:], face_starts[1:])
    np.cumsum(starts, out=starts)
    np.cumsum(face_starts, out=face_starts)
    vertices, faces = empty(int(starts[-1]), 3), torch.empty(int(face_starts[-1]), 3, dtype=torch.int64)
    values = empty(int(starts[-1]), voxels.shape[2] - 2)
    outputs = vertices.numpy(), values.numpy(), faces.numpy()
    _write(*given, fans, counts, packed, starts, face_starts, *outputs)
    return vertices, values, faces
