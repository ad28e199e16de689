"""Numba: a task takes some of the blocks that may be in the picture, voxel by voxel."""

import math

import numpy as np
from numba import njit, prange

from ..block_hash import SIDE, VOXELS
from . import BEHIND_DEPTH, UNCOLOURED

ZERO, HALF, ONE, INFINITE = np.float32(0), np.float32(0.5), np.float32(1), np.float32(np.inf)
MIN_DEPTH, NONE = np.float32(BEHIND_DEPTH), np.float32(UNCOLOURED)
MARGIN = np.float32(1.001)  # of a block's ball, for rounding


@njit(cache=True, error_model="numpy")
def _visible(blocks, height, width, pose, lens, voxel, farthest, chosen):
    """Numbers of the blocks whose ball reaches into the picture's frustum; returns how many there are."""
    count, radius = 0, MARGIN * voxel * np.float32(0.5 * (SIDE - 1) * math.sqrt(3.0))
    middle = np.float32(0.5 * (SIDE - 1))
    left, top = lens[2] / lens[0], lens[3] / lens[1]
    right, bottom = (np.float32(width) - lens[2]) / lens[0], (np.float32(height) - lens[3]) / lens[1]
    slant_l, slant_r = radius * np.sqrt(ONE + left * left), radius * np.sqrt(ONE + right * right)
    slant_t, slant_b = radius * np.sqrt(ONE + top * top), radius * np.sqrt(ONE + bottom * bottom)
    for i in range(len(blocks)):
        x = voxel * (np.float32(SIDE * blocks[i, 0]) + middle) - pose[0, 3]
        y = voxel * (np.float32(SIDE * blocks[i, 1]) + middle) - pose[1, 3]
        z = voxel * (np.float32(SIDE * blocks[i, 2]) + middle) - pose[2, 3]
        w = pose[0, 2] * x + pose[1, 2] * y + pose[2, 2] * z
        if w < -radius or x * x + y * y + z * z > (farthest + radius) * (farthest + radius):
            continue
        u = pose[0, 0] * x + pose[1, 0] * y + pose[2, 0] * z
        v = pose[0, 1] * x + pose[1, 1] * y + pose[2, 1] * z
        if u + left * w < -slant_l or right * w - u < -slant_r or v + top * w < -slant_t or bottom * w - v < -slant_b:
            continue
        chosen[count] = i
        count += 1
    return count


@njit(inline="always", error_model="numpy")
def _four(values, top, left, below, right, a, b, c, d):
    return a * values[top, left] + b * values[top, right] + c * values[below, left] + d * values[below, right]


@njit(parallel=True, cache=True, error_model="numpy")
def _fuse(voxels, blocks, chosen, depth, rgb, trust, pose, lens, voxel, truncation, edge, max_weight):
    height, width = depth.shape
    over = ONE / truncation
    last_x, last_y = np.float32(width - 1), np.float32(height - 1)
    for c in prange(len(chosen)):
        number = chosen[c]
        for i in range(VOXELS):
            px = voxel * np.float32(SIDE * blocks[number, 0] + (i >> 6)) - pose[0, 3]
            py = voxel * np.float32(SIDE * blocks[number, 1] + ((i >> 3) & 7)) - pose[1, 3]
            pz = voxel * np.float32(SIDE * blocks[number, 2] + (i & 7)) - pose[2, 3]
            qz = pose[0, 2] * px + pose[1, 2] * py + pose[2, 2] * pz
            if not qz > MIN_DEPTH:
                continue
            qx = pose[0, 0] * px + pose[1, 0] * py + pose[2, 0] * pz
            qy = pose[0, 1] * px + pose[1, 1] * py + pose[2, 1] * pz
            x, y = qx / qz * lens[0] + lens[2], qy / qz * lens[1] + lens[3]
            if not (x >= ZERO and y >= ZERO and x < np.float32(width) and y < np.float32(height)):
                continue
            u, v = min(max(x - HALF, ZERO), last_x), min(max(y - HALF, ZERO), last_y)
            left, top = int(u), int(v)
            right, below = min(left + 1, width - 1), min(top + 1, height - 1)
            d0, d1, d2, d3 = depth[top, left], depth[top, right], depth[below, left], depth[below, right]
            nearest, farthest = min(min(d0, d1), min(d2, d3)), max(max(d0, d1), max(d2, d3))
            if not (nearest > ZERO and farthest < INFINITE and d0 + d1 + d2 + d3 > ZERO):
                continue
            u, v = u - np.float32(left), v - np.float32(top)
            wa, wb, wc, wd = (ONE - v) * (ONE - u), (ONE - v) * u, v * (ONE - u), v * u
            smooth = farthest - nearest <= edge * nearest
            if not smooth:
                column, row = int(x), int(y)
                wa, wb, wc, wd = ONE, ZERO, ZERO, ZERO
                left, right, top, below = column, column, row, row
            surface = _four(depth, top, left, below, right, wa, wb, wc, wd)
            d = (surface - np.sqrt(px * px + py * py + pz * pz)) * over
            if d < -ONE:
                continue
            w = _four(trust, top, left, below, right, wa, wb, wc, wd)
            if not w > ZERO:
                continue
            weight = voxels[number, i, 1]
            share = w / (weight + w)
            voxels[number, i, 0] += share * (min(d, ONE) - voxels[number, i, 0])
            voxels[number, i, 1] = min(weight + w, max_weight)
            if d < ONE:
                fresh = voxels[number, i, 2] == NONE
                for channel in range(3):
                    colour = (
                        wa * rgb[top, left, channel] + wb * rgb[top, right, channel]
                        + wc * rgb[below, left, channel] + wd * rgb[below, right, channel]
                    )  # fmt: skip
                    own = voxels[number, i, 2 + channel]
                    voxels[number, i, 2 + channel] = colour if fresh else own + share * (colour - own)


def run(voxels, blocks, depth, rgb, trust, pose, lens, voxel, truncation, edge, max_weight):
    blocks, *given = (x.detach().contiguous().numpy() for x in (blocks, depth, rgb, trust, pose, lens))
    depth, _, _, pose, lens = given
    measured = depth[np.isfinite(depth)]
    chosen = np.empty(len(blocks), np.int64)
    voxel, truncation = np.float32(voxel), np.float32(truncation)
    farthest = np.float32(measured.max(initial=0)) + truncation
    count = _visible(blocks, *depth.shape, pose, lens, voxel, farthest, chosen)
    numbers = voxel, truncation, np.float32(edge), np.float32(max_weight)
    _fuse(voxels.numpy(), blocks, chosen[:count], *given, *numbers)
