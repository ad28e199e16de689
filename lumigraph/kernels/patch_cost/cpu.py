"""Numba. A task takes a run of pixels. A window is weighted once, then compared for each neighbour and plane."""

import numpy as np
from numba import njit, prange

from .._operation import empty
from . import BEHIND_DEPTH, MIN_VARIANCE

BORDER = 3  # zeros around a neighbour: one pixel before, two behind, where two are looked up beside each other
CHUNK = 256  # pixels of a task
E, MIN_DEPTH = np.float32(MIN_VARIANCE), np.float32(BEHIND_DEPTH)
ZERO, HALF, ONE, TINY = np.float32(0), np.float32(0.5), np.float32(1), np.float32(1e-12)
ONE_PIXEL = np.uint32(1)
FAST = {"fastmath": True, "error_model": "numpy"}


@njit(**FAST)
def _window(reference, trust, row, column, dx, dy, apart, sharpness, a, w):
    """Values of a window, less that of its centre, and their bilateral weights. Returns the sum of weights."""
    height, width = reference.shape
    centre, total = reference[row, column], ZERO
    for k in range(len(apart)):
        y, x = row + dy[k], column + dx[k]
        inside = 0 <= y < height and 0 <= x < width
        value = reference[y, x] - centre if inside else ZERO
        weight = trust[y, x] * np.exp(-value * value * sharpness - apart[k]) if inside else ZERO
        a[k], w[k] = value, weight
        total += weight
    return total


@njit(**FAST)
def _cost(
    warps, n, planes, p, m, x, y, across, down, a, w, whole, shift, values, weights, rows, columns, masked, samples
):
    """One less the correlation. The loop stores nothing, so that the compiler vectorises it, look-ups included. Arrays
    are passed whole: reference counting of a view takes as long as the loop.

    n: number of the neighbour; p, m: of the pixel and its plane
    values, weights: the neighbours' W b and W with a border; weights are read only where `masked`
    shift: near both pictures' values, subtracted so that squares stay small
    samples: a tuple, one entry for each, so that their number is a compile-time constant
    """
    h, g, g_ = planes[p, m, 0], planes[p, m, 1], planes[p, m, 2]
    u0 = warps[n, 0, 0] * x + warps[n, 0, 1] * y + warps[n, 0, 2] + h * warps[n, 0, 3]
    v0 = warps[n, 1, 0] * x + warps[n, 1, 1] * y + warps[n, 1, 2] + h * warps[n, 1, 3]
    s0 = warps[n, 2, 0] * x + warps[n, 2, 1] * y + warps[n, 2, 2] + h * warps[n, 2, 3]
    across_u, down_u = warps[n, 0, 0] + g * warps[n, 0, 3], warps[n, 0, 1] + g_ * warps[n, 0, 3]
    across_v, down_v = warps[n, 1, 0] + g * warps[n, 1, 3], warps[n, 1, 1] + g_ * warps[n, 1, 3]
    across_s, down_s = warps[n, 2, 0] + g * warps[n, 2, 3], warps[n, 2, 1] + g_ * warps[n, 2, 3]
    right, bottom = np.float32(columns + 1), np.float32(rows + 1)
    stride = columns + BORDER
    first = n * (rows + BORDER) * stride
    ones = of_a = of_b = of_aa = of_bb = of_ab = ZERO
    for k in range(len(samples)):
        s = s0 + across_s * across[k] + down_s * down[k]
        inverse = ONE / s if s > MIN_DEPTH else ZERO
        u = (u0 + across_u * across[k] + down_u * down[k]) * inverse + HALF
        v = (v0 + across_v * across[k] + down_v * down[k]) * inverse + HALF
        u = min(max(u, ZERO), right) if s > MIN_DEPTH else ZERO  # on the border where nothing is seen
        v = min(max(v, ZERO), bottom)
        i, j = np.int32(u), np.int32(v)
        fx, fy = u - np.float32(i), v - np.float32(j)
        at = np.uint32(first + j * stride + i)
        below = np.uint32(at + stride)
        A, B, C, D = (ONE - fx) * (ONE - fy), fx * (ONE - fy), (ONE - fx) * fy, fx * fy
        its = A * values[at] + B * values[at + ONE_PIXEL] + C * values[below] + D * values[below + ONE_PIXEL]
        if masked:
            seen = A * weights[at] + B * weights[at + ONE_PIXEL] + C * weights[below] + D * weights[below + ONE_PIXEL]
        else:
            seen = max(min(min(u, right - u), ONE), ZERO) * max(min(min(v, bottom - v), ONE), ZERO)
        n = w[k] * seen
        wb = w[k] * (its - shift * seen)
        ones += n
        of_a += n * a[k]
        of_b += wb
        of_aa += n * a[k] * a[k]
        of_bb += wb * (its - shift * seen) / max(seen, TINY)
        of_ab += wb * a[k]
    inverse = ONE / max(ones, TINY)
    mean_a, mean_b = of_a * inverse, of_b * inverse
    variance_a = max(of_aa * inverse - mean_a * mean_a, ZERO) + E
    variance_b = max(of_bb * inverse - mean_b * mean_b, ZERO) + E
    covariance = of_ab * inverse - mean_a * mean_b
    return ONE - ones / max(whole, TINY) * covariance / np.sqrt(variance_a * variance_b)


@njit(parallel=True, cache=True, **FAST)
def _costs(
    reference, trust, values, weights, masked, rows, columns, warps, pixels, views, planes, dx, dy, apart, sharpness,
    samples, out,
):  # fmt: skip
    width = reference.shape[1]
    for chunk in prange((len(pixels) + CHUNK - 1) // CHUNK):
        a, w, across, down = np.empty((4, len(samples)), np.float32)
        for k in range(len(samples)):
            across[k], down[k] = np.float32(dx[k]), np.float32(dy[k])
        for p in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(pixels))):
            row, column = pixels[p] // width, pixels[p] % width
            whole = _window(reference, trust, row, column, dx, dy, apart, sharpness, a, w)
            x, y, shift = np.float32(column) + HALF, np.float32(row) + HALF, reference[row, column]
            for m in range(planes.shape[1]):
                for i in range(views.shape[1]):
                    n = views[p, i]
                    out[p, m, i] = _cost(
                        warps, n, planes, p, m, x, y, across, down, a, w, whole, shift, values, weights, rows,
                        columns, masked, samples,
                    )  # fmt: skip


def run(reference, trust, neighbours, neighbour_trust, warps, pixels, views, planes, window, deviation):
    count, rows, columns = neighbours.shape
    values, weights = np.zeros((2, count, rows + BORDER, columns + BORDER), np.float32)
    weights[:, 1 : rows + 1, 1 : columns + 1] = neighbour_trust.numpy()
    values[:, 1 : rows + 1, 1 : columns + 1] = (neighbour_trust * neighbours).numpy()
    dx, dy = np.array(window).T.copy()
    apart = ((dx**2 + dy**2) / (2 * (window[-1][1] + 1) ** 2)).astype(np.float32)
    out = empty(len(pixels), planes.shape[1], views.shape[1])
    given = (x.contiguous().numpy() for x in (reference, trust))
    pictures = values.ravel(), weights.ravel(), bool((neighbour_trust < 1).any())
    placed = (x.contiguous().numpy() for x in (warps, pixels, views, planes))
    samples = dx, dy, apart, np.float32(1 / (2 * deviation**2)), (0,) * len(window)
    _costs(*given, *pictures, rows, columns, *placed, *samples, out.numpy())
    return out
