"""Numba. A task takes one plane down all rows: it looks up a row in each neighbour, adds six quantities along windows,
keeps as many rows of these as a window has in cache, and adds them across."""

import numpy as np
from numba import njit, prange

from .._operation import empty
from . import BEHIND_DEPTH, MIN_VARIANCE

BORDER = 3  # zeros around a neighbour: one pixel before, two behind, where two are looked up beside each other
QUANTITIES = 6  # sums over a window of w, w a, w b, w a a, w b b, w a b
E, MIN_DEPTH = np.float32(MIN_VARIANCE), np.float32(BEHIND_DEPTH)
MAX_COST = np.float32(4)  # more than any cost
ZERO, HALF, ONE, TINY = np.float32(0), np.float32(0.5), np.float32(1), np.float32(1e-12)


@njit(fastmath=True, error_model="numpy")
def _place(warp, h, y, rows, columns, u, v):
    """Neighbour coordinates of row y, counted from the border's first pixel; on the border if invisible."""
    y = np.float32(y) + HALF
    u0 = warp[0, 1] * y + warp[0, 2] + h * warp[0, 3]
    v0 = warp[1, 1] * y + warp[1, 2] + h * warp[1, 3]
    s0 = warp[2, 1] * y + warp[2, 2] + h * warp[2, 3]
    across_u, across_v, across_s = warp[0, 0], warp[1, 0], warp[2, 0]
    right, bottom = np.float32(columns + 1), np.float32(rows + 1)
    for x in range(len(u)):
        centre = np.float32(x) + HALF
        s = across_s * centre + s0
        before = s > MIN_DEPTH
        inverse = ONE / s if before else ZERO
        u[x] = min(max((across_u * centre + u0) * inverse + HALF, ZERO), right) if before else ZERO
        v[x] = min(max((across_v * centre + v0) * inverse + HALF, ZERO), bottom)


@njit(fastmath=True, error_model="numpy")
def _look_up(pixels, stride, u, v, seen, its):
    """Bilinear interpolation of trust, and of trust times value. The compiler does not vectorise this loop."""
    for x in range(len(u)):
        column, row = np.int32(u[x]), np.int32(v[x])
        right, down = u[x] - np.float32(column), v[x] - np.float32(row)
        a, b = np.uint32(2 * (row * stride + column)), np.uint32(2 * ((row + 1) * stride + column))
        above, below = (ONE - right) * (ONE - down), (ONE - right) * down
        above_right, below_right = right * (ONE - down), right * down
        seen[x] = above * pixels[a] + above_right * pixels[a + 2] + below * pixels[b] + below_right * pixels[b + 2]
        its[x] = (
            above * pixels[a + 1] + above_right * pixels[a + 3] + below * pixels[b + 1] + below_right * pixels[b + 3]
        )


@njit(fastmath=True, error_model="numpy")
def _products(a, trust, seen, its, line):
    """Terms of the sums over a window: w, w a, w b, w a a, w b b, w a b."""
    ones, of_a, of_b, of_aa, of_bb, of_ab = line[0], line[1], line[2], line[3], line[4], line[5]
    for x in range(len(a)):
        w, wb = trust[x] * seen[x], trust[x] * its[x]
        ones[x] = w
        of_a[x] = w * a[x]
        of_b[x] = wb
        of_aa[x] = w * a[x] * a[x]
        of_bb[x] = wb * its[x] / max(seen[x], TINY)
        of_ab[x] = wb * a[x]


@njit(fastmath=True, error_model="numpy")
def _along(line, window, sums):
    for q in range(QUANTITIES):
        values, out = line[q], sums[q]
        for x in range(len(out)):
            total = values[x]
            for k in range(1, len(window)):
                total += values[x + k]
            out[x] = total


@njit(fastmath=True, error_model="numpy")
def _across(ring, window, total):
    for q in range(QUANTITIES):
        out = total[q]
        for x in range(len(out)):
            added = ring[0, q, x]
            for k in range(1, len(window)):
                added += ring[k, q, x]
            out[x] = added


@njit(fastmath=True, error_model="numpy")
def _cost(total, share, cost):
    ones, of_a, of_b, of_aa, of_bb, of_ab = total[0], total[1], total[2], total[3], total[4], total[5]
    for x in range(len(cost)):
        n = ONE / max(ones[x], TINY)
        mean_a, mean_b = of_a[x] * n, of_b[x] * n
        variance_a = max(of_aa[x] * n - mean_a * mean_a, ZERO) + E
        variance_b = max(of_bb[x] * n - mean_b * mean_b, ZERO) + E
        covariance = of_ab[x] * n - mean_a * mean_b
        cost[x] = ONE - ones[x] * share * covariance / np.sqrt(variance_a * variance_b)


@njit(fastmath=True, error_model="numpy")
def _keep_least(cost, least):
    """Insert a row of costs into the sorted list of the least so far."""
    for k in range(len(least)):
        for x in range(len(cost)):
            c, lower = cost[x], least[k, x]
            least[k, x] = min(c, lower)
            cost[x] = max(c, lower)


@njit(fastmath=True, error_model="numpy")
def _mean(least, out):
    for x in range(len(out)):
        total = least[0, x]
        for k in range(1, len(least)):
            total += least[k, x]
        out[x] = total / np.float32(len(least))


@njit(parallel=True, fastmath=True, error_model="numpy", cache=True)
def _sweep(reference, trust, pixels, rows, columns, warps, hypotheses, window, best, out):
    height, width = reference.shape
    count, margin, stride = len(warps), len(window) // 2, columns + BORDER
    share = ONE / np.float32(len(window) ** 2)
    for plane in prange(len(hypotheses)):
        u, v, seen, its, cost = np.empty((5, width), np.float32)
        line = np.zeros((QUANTITIES, width + 2 * margin), np.float32)
        inner = line[:, margin:]
        rings = np.zeros((count, len(window), QUANTITIES, width), np.float32)
        total = np.empty((QUANTITIES, width), np.float32)
        least = np.empty((best, width), np.float32)
        for y in range(height + margin):
            middle = y - margin
            least[:] = MAX_COST
            for n in range(count):
                sums = rings[n, y % len(window)]
                if y < height:
                    _place(warps[n], hypotheses[plane], y, rows, columns, u, v)
                    _look_up(pixels[n], stride, u, v, seen, its)
                    _products(reference[y], trust[y], seen, its, inner)
                    _along(line, window, sums)
                else:
                    sums[:] = ZERO
                if middle >= 0:
                    _across(rings[n], window, total)
                    _cost(total, share, cost)
                    _keep_least(cost, least)
            if middle >= 0:
                _mean(least, out[plane, middle])


def run(reference, trust, neighbours, neighbour_trust, warps, hypotheses, window, best):
    count, rows, columns = neighbours.shape
    pixels = np.zeros((count, rows + BORDER, columns + BORDER, 2), np.float32)
    pixels[:, 1 : rows + 1, 1 : columns + 1, 0] = neighbour_trust.numpy()
    pixels[:, 1 : rows + 1, 1 : columns + 1, 1] = (neighbour_trust * neighbours).numpy()
    out = empty(len(hypotheses), *reference.shape)
    given = (x.contiguous().numpy() for x in (reference, trust))
    placed = (x.contiguous().numpy() for x in (warps, hypotheses))
    _sweep(*given, pixels.reshape(count, -1), rows, columns, *placed, (0,) * window, best, out.numpy())
    return out
