"""Numba. Threads share the rows; pixels of one colour read only those of the other."""

import numpy as np
import torch
from numba import njit, prange

ZERO = np.float32(0)


@njit(parallel=True, cache=True, error_model="numpy")
def _half_step(flow, data, right, below, odd, relaxation):
    height, width = right.shape
    for y in prange(height):
        for x in range((y + odd) % 2, width, 2):
            total, u, v = ZERO, data[y, x, 3], data[y, x, 4]
            if x + 1 < width:
                w = right[y, x]
                total, u, v = total + w, u + w * flow[y, x + 1, 0], v + w * flow[y, x + 1, 1]
            if x > 0:
                w = right[y, x - 1]
                total, u, v = total + w, u + w * flow[y, x - 1, 0], v + w * flow[y, x - 1, 1]
            if y + 1 < height:
                w = below[y, x]
                total, u, v = total + w, u + w * flow[y + 1, x, 0], v + w * flow[y + 1, x, 1]
            if y > 0:
                w = below[y - 1, x]
                total, u, v = total + w, u + w * flow[y - 1, x, 0], v + w * flow[y - 1, x, 1]
            u = (u - data[y, x, 1] * flow[y, x, 1]) / (data[y, x, 0] + total)
            flow[y, x, 0] += relaxation * (u - flow[y, x, 0])
            v = (v - data[y, x, 1] * flow[y, x, 0]) / (data[y, x, 2] + total)
            flow[y, x, 1] += relaxation * (v - flow[y, x, 1])


def run(start, data, right, below, iterations, relaxation):
    out = start.clone(memory_format=torch.contiguous_format)
    given = [x.contiguous().numpy() for x in (data, right, below)]
    for step in range(2 * iterations):
        _half_step(out.numpy(), *given, step % 2, np.float32(relaxation))
    return out
