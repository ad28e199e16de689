"""Numba: Gaussians are sorted by depth once; then each thread fills the lists of some rows of tiles in that order."""

import math

import numpy as np
import torch
from numba import get_num_threads, njit, prange

from ..project import MIN_ALPHA as _MIN_ALPHA

FAST = {"cache": True, "nogil": True, "fastmath": {"contract", "nsz", "arcp"}, "error_model": "numpy"}
MIN_ALPHA, LOG_MIN_ALPHA = np.float32(_MIN_ALPHA), math.log(_MIN_ALPHA)
BITS = 11  # of a depth, in each of three passes of the sort
HALF, ONE = np.float32(0.5), np.float32(1)


@njit(**FAST)
def _near_first(depths, opacities):
    """Indices of the visible Gaussians by depth; a stable sort of the floats' bits, valid for floats >= 0."""
    bits = depths.view(np.uint32)
    order = np.flatnonzero(opacities > MIN_ALPHA).astype(np.int32)
    other = np.empty_like(order)
    for shift in (0, BITS, 2 * BITS):
        counts = np.zeros(2**BITS + 1, np.int64)
        for k in range(len(order)):
            counts[((bits[order[k]] >> np.uint32(shift)) & np.uint32(2**BITS - 1)) + 1] += 1
        counts = np.cumsum(counts)
        for k in range(len(order)):
            key = (bits[order[k]] >> np.uint32(shift)) & np.uint32(2**BITS - 1)
            other[counts[key]] = order[k]
            counts[key] += 1
        order, other = other, order
    return order


@njit(parallel=True, **FAST)
def _measure(order, centres, conics, opacities, size, side, ellipses, rows):
    """Ellipse parameters for `_span`, first and last row of tiles, and most columns of each Gaussian, by depth."""
    down, across = (size[1] + side - 1) // side, (size[0] + side - 1) // side
    for k in prange(len(order)):
        i = order[k]
        a, b, c = np.float64(conics[i, 0]), np.float64(conics[i, 1]), np.float64(conics[i, 2])
        upright = max(c - b * b / a, 1e-30)
        limit = 2 * (math.log(opacities[i]) - LOG_MIN_ALPHA)
        high = math.sqrt(limit / upright)  # from the centre to the lowest point
        ellipses[k, 0], ellipses[k, 1] = centres[i, 0], centres[i, 1]
        ellipses[k, 2], ellipses[k, 3] = limit / a, upright / a
        ellipses[k, 4] = b / a
        ellipses[k, 5] = -b / c * math.sqrt(limit * c / (a * upright))  # how far below it the ellipse is widest
        # Rows whose pixel centres lie between the highest and the lowest point.
        first = math.ceil((min(max(centres[i, 1] - high, -1e6), 1e6) - side + HALF) / side)
        last = math.floor((min(max(centres[i, 1] + high, -1e6), 1e6) - HALF) / side)
        rows[k, 0], rows[k, 1] = max(first, 0), min(last, down - 1)
        wide = math.sqrt(limit * c / (a * upright))
        rows[k, 2] = min(across, np.int64(min(2 * wide / side, 1e6)) + 2)
        if math.isnan(centres[i, 0] + centres[i, 1] + high + wide):  # nowhere
            rows[k, 0], rows[k, 1], rows[k, 2] = 0, -1, 0


@njit(inline="always")
def _span(ellipse, top, bottom):
    """Left and right extent of an ellipse between two heights, from its centre; right < left for none."""
    upper, lower = top - ellipse[1], bottom - ellipse[1]
    y = min(max(ellipse[5], upper), lower)
    room = ellipse[2] - ellipse[3] * y * y
    if room < 0:
        return ONE, -ONE
    right = math.sqrt(room) - ellipse[4] * y
    y = min(max(-ellipse[5], upper), lower)
    room = max(ellipse[2] - ellipse[3] * y * y, np.float32(0))
    return -math.sqrt(room) - ellipse[4] * y, right


@njit(parallel=True, **FAST)
def _hand_out(order, ellipses, rows, size, side, bands, room, counts, tiles, pairs, used):
    """Write the pairs (tile, Gaussian) of each band of rows by depth, from room[band] on, and count them."""
    width, height = size
    across = (width + side - 1) // side
    for band in prange(len(bands) - 1):
        begin, end, at = bands[band], bands[band + 1], room[band]
        for k in range(len(order)):
            for row in range(max(rows[k, 0], begin), min(rows[k, 1], end - 1) + 1):
                top, bottom = row * side + HALF, min((row + 1) * side, height) - HALF
                left, right = _span(ellipses[k], np.float32(top), np.float32(bottom))
                left, right = left + ellipses[k, 0], right + ellipses[k, 0]
                if right < HALF or left > width - HALF or right < left:
                    continue
                first = max(math.ceil((max(left, -np.float32(side)) - side + HALF) / side), 0)
                last = min(math.floor((min(right, np.float32(width)) - HALF) / side), across - 1)
                for column in range(first, last + 1):
                    tile = row * across + column
                    tiles[at], pairs[at] = tile, order[k]
                    counts[tile] += 1
                    at += 1
        used[band] = at


@njit(parallel=True, **FAST)
def _sort(tiles, pairs, room, used, starts, out):
    """Sort pairs into their tiles' lists, stably."""
    for band in prange(len(room) - 1):
        for at in range(room[band], used[band]):
            tile = tiles[at]
            out[starts[tile]] = pairs[at]
            starts[tile] += 1


@njit(cache=True)
def _room(rows, bands):
    """Write offset of each band."""
    room = np.zeros(len(bands), np.int64)
    for k in range(len(rows)):
        for band in range(len(bands) - 1):
            inside = min(rows[k, 1] + 1, bands[band + 1]) - max(rows[k, 0], bands[band])
            room[band + 1] += max(inside, 0) * rows[k, 2]
    return np.cumsum(room)


def run(centres, conics, opacities, depths, size, side):
    centres, conics, opacities, depths = (x.contiguous().numpy() for x in (centres, conics, opacities, depths))
    across, down = -(-size[0] // side), -(-size[1] // side)
    order = _near_first(depths, opacities)
    ellipses, rows = np.empty((len(order), 6), np.float32), np.empty((len(order), 3), np.int32)
    _measure(order, centres, conics, opacities, size, side, ellipses, rows)
    parts = min(get_num_threads(), down)
    bands = np.arange(parts + 1) * down // parts
    room = _room(rows, bands)
    tiles, pairs = np.empty(room[-1], np.int32), np.empty(room[-1], np.int32)
    counts, used = np.zeros(across * down, np.int64), np.empty(parts, np.int64)
    _hand_out(order, ellipses, rows, size, side, bands, room, counts, tiles, pairs, used)
    starts = np.concatenate([[0], np.cumsum(counts)])
    out = np.empty(starts[-1], np.int32)
    _sort(tiles, pairs, room, used, starts[:-1].copy(), out)
    return torch.from_numpy(out), torch.from_numpy(starts)
