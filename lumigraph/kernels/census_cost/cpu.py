"""Numba. Signatures are integers. The right picture is mirrored, so that disparities run forward in memory."""

import numpy as np
from numba import njit, prange, types
from numba.extending import intrinsic, overload

from .._operation import empty
from . import DIFFERENCE_SHIFT, MAX_DIFFERENCE, OFFSETS, REACH, UNSEEN_COST

PLACES = np.array(OFFSETS)
SHIFT, CAP, UNSEEN = np.uint8(DIFFERENCE_SHIFT), np.uint8(MAX_DIFFERENCE), np.uint8(UNSEEN_COST)
ONE, NO_BITS, ALL_BITS = np.uint32(1), np.uint32(0), np.uint8(255)
FAST = {"error_model": "numpy"}


def _bits(x):
    """Population count: number of set bits."""
    return int(x).bit_count()


@intrinsic
def _count(typing, x):
    return types.uint32(types.uint32), lambda context, builder, sig, args: builder.ctpop(args[0])


overload(_bits)(lambda x: lambda x: _count(x))


@njit(parallel=True, cache=True, **FAST)
def _signatures(padded, places, out):
    """Census signatures. padded: the picture with a border of REACH pixels"""
    height, width = out.shape
    for y in prange(height):
        out[y] = NO_BITS
        for k in range(len(places)):
            column, row = places[k, 0] + REACH, y + places[k, 1] + REACH
            for x in range(width):
                darker = np.uint32(padded[row, x + column] < padded[y + REACH, x + REACH])
                out[y, x] = np.uint32((out[y, x] << ONE) | darker)


@njit(parallel=True, cache=True, **FAST)
def _costs(codes, its_codes, left, right, left_valid, right_valid, first, out):
    height, width, count = out.shape
    for y in prange(height):
        code, grey = np.empty(width, np.uint32), np.empty(width, np.uint8)
        seen = np.empty(width, np.uint8)
        for x in range(width):
            code[x], grey[x] = its_codes[y, width - 1 - x], right[y, width - 1 - x]
            seen[x] = ALL_BITS if right_valid[y, width - 1 - x] else NO_BITS
        for x in range(width):
            a, g, cost = codes[y, x], left[y, x], out[y, x]
            begin = width - 1 - x + first  # x - first - k is at begin + k of the mirrored row
            low = min(max(-begin, 0), count)
            high = max(min(width - begin, count), low) if left_valid[y, x] else low
            cost[:low] = UNSEEN
            cost[high:] = UNSEEN
            start, goal = np.uint64(max(begin + low, 0)), np.uint64(low)  # unsigned: no negative index to look for
            for k in range(np.uint64(high - low)):
                b = grey[start + k]
                difference = min(np.uint8(np.uint8(max(g, b) - min(g, b)) >> SHIFT), CAP)
                unlike = np.uint8(np.uint8(_bits(np.uint32(a ^ code[start + k]))) + difference)
                cost[goal + k] = max(unlike & seen[start + k], UNSEEN & ~seen[start + k])


def run(left, right, left_valid, right_valid, first, count):
    codes = []
    for picture in (left, right):
        codes.append(np.empty(picture.shape, np.uint32))
        _signatures(np.pad(picture.numpy(), REACH, mode="edge"), PLACES, codes[-1])
    out = empty(*left.shape, count, dtype=left.dtype)
    pictures = (x.contiguous().numpy() for x in (left, right, left_valid, right_valid))
    _costs(*codes, *pictures, first, out.numpy())
    return out
