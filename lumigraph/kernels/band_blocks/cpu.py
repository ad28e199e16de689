"""Numba: one ray after another. New blocks go to a small hash table of their own and are sorted at the end."""

import math

import numpy as np
import torch
from numba import njit

from ..block_hash import EMPTY
from ..block_hash.cpu import find, slot_of

NONE = np.int32(EMPTY)
ONE, HALF, ZERO = np.float32(1), np.float32(0.5), np.float32(0)
FIRST_SLOTS = 1 << 12
FAR = np.int32(2**31 - 1)  # coordinate of no block


@njit(cache=True, error_model="numpy")
def _place(new, count, own):
    """Rebuild the hash table `own` of the new blocks."""
    own[:] = NONE
    mask = len(own) - 1
    for i in range(count):
        slot = slot_of(new[i, 0], new[i, 1], new[i, 2], mask)
        while own[slot] != NONE:
            slot = (slot + 1) & mask
        own[slot] = i


@njit(cache=True, error_model="numpy")
def _walk(depth, pose, lens, blocks, table, side, truncation, steps, begin, new, count, own):
    """Collect blocks along rays from pixel `begin` on, until `new` is half full. Returns next pixel and count."""
    height, width = depth.shape
    mask, step = len(own) - 1, np.float32(2) * truncation / np.float32(steps)
    for pixel in range(begin, height * width):
        t = depth[pixel // width, pixel % width]
        if not (t > ZERO and t < np.float32(np.inf)):
            continue
        if count + steps >= len(new):
            return pixel, count
        u = (np.float32(pixel % width) + HALF - lens[2]) / lens[0]
        v = (np.float32(pixel // width) + HALF - lens[3]) / lens[1]
        length = ONE / np.sqrt(u * u + v * v + ONE)
        dx = (pose[0, 0] * u + pose[0, 1] * v + pose[0, 2]) * length
        dy = (pose[1, 0] * u + pose[1, 1] * v + pose[1, 2]) * length
        dz = (pose[2, 0] * u + pose[2, 1] * v + pose[2, 2]) * length
        last_x, last_y, last_z = FAR, FAR, FAR
        for k in range(steps + 1):
            s = t - truncation + step * np.float32(k)
            x = np.int32(math.floor((pose[0, 3] + s * dx) / side))
            y = np.int32(math.floor((pose[1, 3] + s * dy) / side))
            z = np.int32(math.floor((pose[2, 3] + s * dz) / side))
            if x == last_x and y == last_y and z == last_z:
                continue
            last_x, last_y, last_z = x, y, z
            if find(x, y, z, blocks, table) >= 0:
                continue
            slot = slot_of(x, y, z, mask)
            while own[slot] != NONE:
                i = own[slot]
                if new[i, 0] == x and new[i, 1] == y and new[i, 2] == z:
                    break
                slot = (slot + 1) & mask
            if own[slot] == NONE:
                own[slot] = count
                new[count, 0], new[count, 1], new[count, 2] = x, y, z
                count += 1
    return height * width, count


def run(depth, pose, lens, blocks, table, side, truncation, steps):
    given = [x.detach().contiguous().numpy() for x in (depth, pose, lens, blocks, table)]
    side, truncation = np.float32(side), np.float32(truncation)
    slots = max(FIRST_SLOTS, 1 << (4 * (steps + 2)).bit_length())
    new, pixel, count = np.empty((0, 3), np.int32), 0, 0
    while pixel < depth.numel():
        new = np.concatenate([new, np.empty((slots // 2 - len(new), 3), np.int32)])
        own = np.empty(slots, np.int32)
        _place(new, count, own)
        pixel, count = _walk(*given, side, truncation, steps, pixel, new, count, own)
        slots *= 2
    found = new[:count]
    return torch.from_numpy(found[np.lexsort((found[:, 2], found[:, 1], found[:, 0]))])
