"""Numba. A task takes a row of patches; a patch's template and gradient are gathered once."""

import math

import numpy as np
from numba import njit, prange

from .._operation import empty
from . import MIN_GRADIENT

E, ZERO, ONE = np.float32(MIN_GRADIENT), np.float32(0), np.float32(1)
FAST = {"fastmath": {"contract", "reassoc", "nsz", "arcp"}, "error_model": "numpy"}


@njit(**FAST)
def _value(picture, x, y):
    height, width = picture.shape
    x, y = min(max(x, ZERO), np.float32(width - 1)), min(max(y, ZERO), np.float32(height - 1))
    left, top = int(x), int(y)
    right, below = min(left + 1, width - 1), min(top + 1, height - 1)
    fx, fy = x - np.float32(left), y - np.float32(top)
    above = (ONE - fx) * picture[top, left] + fx * picture[top, right]
    return (ONE - fy) * above + fy * ((ONE - fx) * picture[below, left] + fx * picture[below, right])


@njit(parallel=True, cache=True, **FAST)
def _flow(start, first, second, gradient, size, stride, iterations, out):
    height, width = first.shape
    rows, columns = start.shape[:2]
    for i in prange(rows):
        T, gx, gy = np.empty((3, size * size), np.float32)
        for j in range(columns):
            k, mean_x, mean_y = 0, ZERO, ZERO
            for dy in range(size):
                for dx in range(size):
                    y, x = min(i * stride + dy, height - 1), min(j * stride + dx, width - 1)
                    T[k], gx[k], gy[k] = first[y, x], gradient[y, x, 0], gradient[y, x, 1]
                    mean_x, mean_y = mean_x + gx[k], mean_y + gy[k]
                    k += 1
            mean_x, mean_y = mean_x / np.float32(k), mean_y / np.float32(k)
            xx, xy, yy = E, ZERO, E
            for k in range(size * size):
                gx[k], gy[k] = gx[k] - mean_x, gy[k] - mean_y
                xx, xy, yy = xx + gx[k] * gx[k], xy + gx[k] * gy[k], yy + gy[k] * gy[k]
            inverse = ONE / (xx * yy - xy * xy)
            u, v = start[i, j, 0], start[i, j, 1]
            for _ in range(iterations):
                k, of_x, of_y = 0, ZERO, ZERO
                for dy in range(size):
                    for dx in range(size):
                        x, y = np.float32(j * stride + dx) + u, np.float32(i * stride + dy) + v
                        off = _value(second, x, y) - T[k]
                        of_x, of_y = of_x + gx[k] * off, of_y + gy[k] * off
                        k += 1
                u -= (yy * of_x - xy * of_y) * inverse
                v -= (xx * of_y - xy * of_x) * inverse
            far = math.hypot(u - start[i, j, 0], v - start[i, j, 1]) > size
            out[i, j, 0], out[i, j, 1] = (start[i, j, 0], start[i, j, 1]) if far else (u, v)


def run(start, first, second, gradient, size, stride, iterations):
    out = empty(*start.shape)
    given = (x.contiguous().numpy() for x in (start, first, second, gradient))
    _flow(*given, size, stride, iterations, out.numpy())
    return out
