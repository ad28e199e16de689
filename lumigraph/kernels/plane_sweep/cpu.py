"""Numba. A task takes one plane down all rows: it looks up a row in each neighbour, adds six quantities along windows,
keeps as many rows of these as a window has in a near cache, and adds them across."""

import numpy as np
from numba import njit, prange

from .._dispatch import empty
from . import BEHIND, VARIANCE

QUANTITIES = 6  # sums over a window of w, w a, w b, w a a, w b b, w a b
E, LEAST = np.float32(VARIANCE), np.float32(BEHIND)
ZERO, HALF, ONE, TINY = np.float32(0), np.float32(0.5), np.float32(1), np.float32(1e-12)


@njit(inline="always")
def _between(flat, at, stride, right, down):
    """The value between four neighbouring pixels."""
    above = (ONE - right) * flat[at] + right * flat[at + 1]
    below = (ONE - right) * flat[at + stride] + right * flat[at + stride + 1]
    return (ONE - down) * above + down * below


@njit(fastmath=True, error_model="numpy")
def _look_up(a, trust, weights, weighted, rows, stride, warp, h, y, line, margin, length):
    """What is to be added up along row y. Pictures have a border of zeros: one pixel before, two behind."""
    width = len(a)
    y = np.float32(y) + HALF
    u0 = warp[0, 1] * y + warp[0, 2] + h * warp[0, 3]
    v0 = warp[1, 1] * y + warp[1, 2] + h * warp[1, 3]
    s0 = warp[2, 1] * y + warp[2, 2] + h * warp[2, 3]
    right_most, lowest = np.float32(stride - 3), np.float32(rows)
    for x in range(width):
        centre = np.float32(x) + HALF
        s = warp[2, 0] * centre + s0
        inverse = ONE / (s if s > LEAST else ONE)
        u = (warp[0, 0] * centre + u0) * inverse + HALF
        v = (warp[1, 0] * centre + v0) * inverse + HALF
        u = min(max(u, ZERO), right_most + ONE) if s > LEAST else ZERO
        v = min(max(v, ZERO), lowest + ONE)
        column, row = np.int32(u), np.int32(v)
        at = row * stride + column
        right, down = u - np.float32(column), v - np.float32(row)
        seen = _between(weights, at, stride, right, down)
        its = _between(weighted, at, stride, right, down)  # W b
        i, t = margin + x, trust[x]
        line[i] = t * seen
        line[length + i] = t * seen * a[x]
        line[2 * length + i] = t * its
        line[3 * length + i] = t * seen * a[x] * a[x]
        line[4 * length + i] = t * its * its / max(seen, TINY)
        line[5 * length + i] = t * its * a[x]


@njit(fastmath=True, error_model="numpy")
def _along(line, length, window, sums, width):
    for q in range(QUANTITIES):
        for x in range(width):
            sums[q * width + x] = line[q * length + x]
        for k in range(1, window):
            for x in range(width):
                sums[q * width + x] += line[q * length + x + k]


@njit(fastmath=True, error_model="numpy")
def _across(ring, total):
    for i in range(len(total)):
        total[i] = ring[0, i]
    for k in range(1, len(ring)):
        for i in range(len(total)):
            total[i] += ring[k, i]


@njit(fastmath=True, error_model="numpy")
def _cost(total, area, cost):
    width = len(cost)
    for x in range(width):
        n = ONE / max(total[x], TINY)
        mean_a, mean_b = total[width + x] * n, total[2 * width + x] * n
        variance_a = max(total[3 * width + x] * n - mean_a * mean_a, ZERO) + E
        variance_b = max(total[4 * width + x] * n - mean_b * mean_b, ZERO) + E
        covariance = total[5 * width + x] * n - mean_a * mean_b
        cost[x] = ONE - total[x] * area * covariance / np.sqrt(variance_a * variance_b)


@njit(fastmath=True, error_model="numpy")
def _keep_least(cost, least):
    """Put a row of costs into its place among the least so far, which are in order."""
    for k in range(len(least)):
        for x in range(len(cost)):
            c, lower = cost[x], least[k, x]
            least[k, x] = min(c, lower)
            cost[x] = max(c, lower)


@njit(parallel=True, fastmath=True, error_model="numpy", cache=True)
def _sweep(reference, trust, weights, weighted, rows, stride, warps, hypotheses, window, best, out):
    height, width = reference.shape
    count, margin = len(warps), window // 2
    length = width + 2 * margin
    for plane in prange(len(hypotheses)):
        line = np.zeros(QUANTITIES * length, np.float32)
        rings = np.zeros((count, window, QUANTITIES * width), np.float32)
        total = np.empty(QUANTITIES * width, np.float32)
        cost = np.empty(width, np.float32)
        least = np.empty((best, width), np.float32)
        for y in range(height + margin):
            middle = y - margin
            least[:] = np.float32(np.inf)
            for n in range(count):
                sums = rings[n, y % window]
                if y < height:
                    _look_up(
                        reference[y],
                        trust[y],
                        weights[n],
                        weighted[n],
                        rows,
                        stride,
                        warps[n],
                        hypotheses[plane],
                        y,
                        line,
                        margin,
                        length,
                    )
                    _along(line, length, window, sums, width)
                else:
                    sums[:] = ZERO
                if middle >= 0:
                    _across(rings[n], total)
                    _cost(total, ONE / np.float32(window * window), cost)
                    _keep_least(cost, least)
            if middle >= 0:
                for x in range(width):
                    added = ZERO
                    for k in range(best):
                        added += least[k, x]
                    out[plane, middle, x] = added / np.float32(best)


def run(reference, trust, neighbours, neighbour_trust, warps, hypotheses, window, best):
    count, rows, columns = neighbours.shape
    weights, weighted = (np.zeros((count, rows + 3, columns + 3), np.float32) for _ in range(2))
    weights[:, 1:-2, 1:-2] = neighbour_trust.numpy()
    weighted[:, 1:-2, 1:-2] = (neighbour_trust * neighbours).numpy()
    out = empty(len(hypotheses), *reference.shape)
    given = (x.contiguous().numpy() for x in (reference, trust))
    pictures = (x.reshape(count, -1) for x in (weights, weighted))
    placed = (x.contiguous().numpy() for x in (warps, hypotheses))
    _sweep(*given, *pictures, rows, columns + 3, *placed, window, best, out.numpy())
    return out
