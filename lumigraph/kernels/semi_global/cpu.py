"""Numba. One sweep down takes four of the directions, one up the other four; both keep a row of L for each. Path costs
are bytes, which compilers vectorise well."""

import numpy as np
from numba import njit, prange

from .._operation import empty
from . import NO_RIVAL

ONE, NO_COST, NOTHING = np.uint64(1), np.uint8(255), np.uint16(NO_RIVAL)
FAST = {"error_model": "numpy"}
DIRECTIONS = 4  # of a sweep: along the row, and from the three nearest pixels of the row before


@njit(**FAST)
def _advance(L, before, here, least, costs, at, total, count, slope, jump):
    """Add L at a pixel to the total and return its minimum. Unsigned indices save the test for negative ones."""
    lowest, limit = NO_COST, np.uint8(least + jump)
    for k in range(count):
        beside = np.uint8(min(L[before + k - ONE], L[before + k + ONE]) + slope)
        value = np.uint8(np.uint8(min(min(L[before + k], beside), limit) - least) + costs[at + k])
        L[here + k] = value
        total[at + k] = np.uint16(total[at + k] + np.uint16(value))
        lowest = min(lowest, value)
    return lowest


@njit(**FAST)
def _sweep(costs, guide, penalties, slope, count, total, back):
    """Aggregate four directions. costs, total: flat. Rows of L are padded by a pixel at both ends, and pixels by two
    disparities, which are never least; L is 0 before the first pixel."""
    height, width = guide.shape
    pixel = count + 2
    row = (width + 2) * pixel
    L = np.zeros(2 * DIRECTIONS * row, np.uint8)
    for i in range(2 * DIRECTIONS * (width + 2)):
        L[i * pixel] = L[(i + 1) * pixel - 1] = np.uint8(NO_COST - slope)
    least = np.zeros((DIRECTIONS, 2, width + 2), np.uint8)
    towards, length = (-1 if back else 1), np.uint64(count)
    for j in range(height):
        y, now = (height - 1 - j if back else j), j & 1
        for i in range(width):
            x = width - 1 - i if back else i
            at = np.uint64((y * width + x) * count)
            for r in range(DIRECTIONS):
                # direction 0 comes from (i - 1, j), 1 to 3 from (i - 2 + r, j - 1)
                there, parity = (i - 1, now) if r == 0 else (i - 2 + r, 1 - now)
                its_y, its_x = (y if r == 0 else y - towards), x + (there - i) * towards
                jump = np.uint8(0)
                if 0 <= its_x < width and 0 <= its_y < height:
                    a, b = guide[y, x], guide[its_y, its_x]
                    jump = penalties[max(a, b) - min(a, b)]
                before = np.uint64((2 * r + parity) * row + (there + 1) * pixel + 1)
                here = np.uint64((2 * r + now) * row + (i + 1) * pixel + 1)
                reached = least[r, parity, there + 1]
                least[r, now, i + 1] = _advance(L, before, here, reached, costs, at, total, length, slope, jump)


@njit(parallel=True, cache=True, **FAST)
def _totals(costs, guide, penalties, slope, count, totals):
    for back in prange(2):
        _sweep(costs, guide, penalties, slope, count, totals[back], back == 1)


@njit(parallel=True, cache=True, **FAST)
def _winners(totals, first, count, left, right, margin):
    height, width = left.shape
    for y in prange(height):
        best, total = np.full(width, NOTHING), np.empty(count, np.uint16)
        for x in range(width):
            right[y, x] = first - 1
        for x in range(width):
            down = np.uint64((y * width + x) * count)
            up = np.uint64(down + np.uint64(height * width * count))
            least, rival = NOTHING, NOTHING
            for k in range(np.uint64(count)):
                total[k] = np.uint16(totals[down + k] + totals[up + k])
                least = min(least, total[k])
            k = 0
            while total[k] != least:
                k += 1
            for e in range(np.uint64(max(k - 1, 0))):
                rival = min(rival, total[e])
            beyond = np.uint64(k + 2)
            for e in range(np.uint64(max(count - k - 2, 0))):
                rival = min(rival, total[beyond + e])
            value = np.float32(first + k)
            if 0 < k < count - 1:
                a, b = np.float32(total[k - 1]), np.float32(total[k + 1])
                slope = np.float32(2) * (max(a, b) - np.float32(least))
                value += (a - b) / slope if slope > 0 else np.float32(0)
            left[y, x], margin[y, x] = value, np.float32(rival) - np.float32(least)
            nearest = x - first  # of the right pixels that this one may meet; as x grows, each meets larger disparities
            for u in range(max(nearest - count + 1, 0), min(nearest, width - 1) + 1):
                met = total[np.uint64(nearest - u)]
                if met < best[np.uint64(u)]:
                    best[np.uint64(u)], right[y, np.uint64(u)] = met, np.float32(first + nearest - u)


def run(costs, guide, penalties, slope_penalty, first):
    height, width, count = costs.shape
    totals = np.zeros((2, costs.numel()), np.uint16)
    given = (x.contiguous().numpy() for x in (costs.reshape(-1), guide, penalties))
    _totals(*given, np.uint8(slope_penalty), count, totals)
    left, right, margin = (empty(height, width) for _ in range(3))
    _winners(totals.reshape(-1), first, count, left.numpy(), right.numpy(), margin.numpy())
    return left, right, margin
