"""The operations of `lanes` number by number, for an engine that runs without Numba; every index is checked."""

from __future__ import annotations

import numpy as np

from .._vectors import LANES
from .lanes import BLOCK as BLOCK

ONE, LAST = np.float32(1), 0xFFFFFFFF


def _place(points, at, axes, resolution, stride_y, stride_z, mask, base, lanes, entries, weights, i):
    flat, strides = points.reshape(-1), (1, int(stride_y), int(stride_z))
    for j in range(min(LANES, points.shape[1] - at)):
        cells, shares = [], []
        for axis in range(3):
            scaled = min(max(flat[at + j + axis * axes], np.float32(0)), ONE) * np.float32(resolution)
            cells.append(min(int(scaled), int(resolution) - 1))
            shares.append(scaled - np.float32(cells[axis]))
        for corner in range(8):
            sides = corner & 1, corner >> 1 & 1, corner >> 2
            x, y, z = ((cell + side) * step & LAST for cell, side, step in zip(cells, sides, strides, strict=True))
            wx, wy, wz = (share if side else ONE - share for share, side in zip(shares, sides, strict=True))
            entry = (x ^ y ^ z) & int(mask) if mask else x + y + z
            entries[corner * BLOCK + i + j] = (entry + int(base)) * len(lanes)
            weights[corner * BLOCK + i + j] = wx * wy * wz


place_dense = place_hashed = _place


def blend(table, entries, weights, i, lanes, out, first, stride):
    for f in range(len(lanes)):
        total = np.float32(0)
        for corner in range(8):
            total += weights[corner * BLOCK + i] * table.reshape(-1)[entries[corner * BLOCK + i] + f]
        out[first + f * stride] = total


def spread(grad, first, stride, entries, weights, i, lanes, table):
    flat = table.reshape(-1)
    for f in range(len(lanes)):
        for corner in range(8):
            flat[entries[corner * BLOCK + i] + f] += weights[corner * BLOCK + i] * grad[first + f * stride]
