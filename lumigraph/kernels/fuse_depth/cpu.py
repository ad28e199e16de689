"""Numba: a task takes some of the blocks in the view frustum, voxel by voxel."""

import math

import numpy as np
import torch
from numba import njit, prange

from ..block_hash import SIDE, VOXELS
from . import BEHIND_DEPTH, CHANNELS, UNCOLOURED

ZERO, HALF, ONE, INFINITE = np.float32(0), np.float32(0.5), np.float32(1), np.float32(np.inf)
MIN_DEPTH, NONE = np.float32(BEHIND_DEPTH), np.float32(UNCOLOURED)
ONE_ON = np.uint64(1)
MARGIN = np.float32(1.001)  # of a block's ball, for rounding


@njit(cache=True, error_model="numpy")
def _visible(blocks, height, width, pose, lens, voxel, farthest, chosen):
    """Numbers of the blocks whose bounding sphere meets the view frustum; returns how many there are."""
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
def _four(values, a, b, c, d, wa, wb, wc, wd):
    return wa * values[a] + wb * values[b] + wc * values[c] + wd * values[d]


@njit(inline="always", error_model="numpy")
def _if_known(depth, weight):
    return weight if depth > ZERO and depth < INFINITE else -ONE


@njit(parallel=True, cache=True, error_model="numpy", fastmath={"contract", "nsz", "arcp"})
def _fuse(
    voxels, blocks, chosen, depth, rgb, trust, height, width, pose, lens, voxel, truncation, edge, max_weight, growth
):
    """Integrate into the chosen blocks. Arrays are flat; indices are unsigned, which saves tests for negative ones."""
    over, wide, high = ONE / truncation, np.float32(width), np.float32(height)
    widening = growth * over
    last_x, last_y = wide - ONE, high - ONE
    step_x, step_y, step_z = voxel * pose[2, 0], voxel * pose[2, 1], voxel * pose[2, 2]
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    for c in prange(len(chosen)):
        number = chosen[c]
        pz0 = voxel * np.float32(SIDE * blocks[number, 2]) - pose[2, 3]
        for row in range(SIDE * SIDE):
            px = voxel * np.float32(SIDE * blocks[number, 0] + (row >> 3)) - pose[0, 3]
            py = voxel * np.float32(SIDE * blocks[number, 1] + (row & 7)) - pose[1, 3]
            qx0 = pose[0, 0] * px + pose[1, 0] * py + pose[2, 0] * pz0
            qy0 = pose[0, 1] * px + pose[1, 1] * py + pose[2, 1] * pz0
            qz0 = pose[0, 2] * px + pose[1, 2] * py + pose[2, 2] * pz0
            across = px * px + py * py
            for k in range(SIDE):
                t = np.float32(k)
                qz = qz0 + t * step_z
                if not qz > MIN_DEPTH:
                    continue
                inverse = ONE / qz
                x, y = (qx0 + t * step_x) * inverse * fx + cx, (qy0 + t * step_y) * inverse * fy + cy
                if not (x >= ZERO and y >= ZERO and x < wide and y < high):
                    continue
                u, v = min(max(x - HALF, ZERO), last_x), min(max(y - HALF, ZERO), last_y)
                left, top = np.int32(u), np.int32(v)
                right, below = min(left + 1, width - 1), min(top + 1, height - 1)
                a, b = np.uint32(top * width + left), np.uint32(top * width + right)
                i, j = np.uint32(below * width + left), np.uint32(below * width + right)
                da, db, dc, dd = depth[a], depth[b], depth[i], depth[j]
                nearest, farthest = min(min(da, db), min(dc, dd)), max(max(da, db), max(dc, dd))
                pz = pz0 + t * voxel
                away = np.sqrt(across + pz * pz)
                if (farthest - away) * over < -ONE - widening * farthest:
                    continue
                u, v = u - np.float32(left), v - np.float32(top)
                wa, wb, wc, wd = (ONE - v) * (ONE - u), (ONE - v) * u, v * (ONE - u), v * u
                if not (nearest > ZERO and farthest - nearest <= edge * nearest):
                    wa, wb = _if_known(da, wa), _if_known(db, wb)
                    wc, wd = _if_known(dc, wc), _if_known(dd, wd)
                    most = max(max(wa, wb), max(wc, wd))
                    if most < ZERO:
                        continue
                    a = a if wa == most else b if wb == most else i if wc == most else j
                    b, i, j = a, a, a
                    wa, wb, wc, wd = ONE, ZERO, ZERO, ZERO
                surface = _four(depth, a, b, i, j, wa, wb, wc, wd)
                d, reach = (surface - away) * over, ONE + widening * surface
                w = _four(trust, a, b, i, j, wa, wb, wc, wd)
                if d < -reach or not w > ZERO:
                    continue
                place = np.uint64(CHANNELS * (VOXELS * number + SIDE * row + k))
                weight = voxels[place + ONE_ON]
                share = w / (weight + w)
                voxels[place] += share * (min(d, reach) - voxels[place])
                voxels[place + ONE_ON] = min(weight + w, max_weight)
                if d < reach:
                    fresh = voxels[place + np.uint64(2)] == NONE
                    for channel in range(3):
                        at = np.uint32(channel)
                        three = np.uint32(3)
                        colour = _four(
                            rgb, three * a + at, three * b + at, three * i + at, three * j + at, wa, wb, wc, wd
                        )
                        own = voxels[place + np.uint64(2 + channel)]
                        voxels[place + np.uint64(2 + channel)] = colour if fresh else own + share * (colour - own)


def run(voxels, blocks, depth, rgb, trust, pose, lens, voxel, truncation, edge, max_weight, growth):
    given = blocks, torch.where(depth > 0, depth, 0), rgb, trust, pose, lens  # what is not a number is not positive
    blocks, depth, rgb, trust, pose, lens = (x.detach().contiguous().numpy() for x in given)
    voxel, truncation = np.float32(voxel), np.float32(truncation)
    farthest = np.where(depth < INFINITE, depth, ZERO).max() * np.float32(1 + growth) + truncation
    chosen = np.empty(len(blocks), np.int64)
    count = _visible(blocks, *depth.shape, pose, lens, voxel, farthest, chosen)
    pixels = (x.reshape(-1) for x in (depth, rgb, trust))
    numbers = voxel, truncation, np.float32(edge), np.float32(max_weight), np.float32(growth)
    _fuse(voxels.view(-1).numpy(), blocks, chosen[:count], *pixels, *depth.shape, pose, lens, *numbers)
