"""Numba: value and gradient in one pass. Threads share slabs as in `sparse_grid`: no two add to one node."""

import numpy as np
import torch
from numba import njit, prange

from .._operation import differentiable
from ..sparse_grid.cpu import row_of, slabs_of
from . import EPSILON

ONE = np.float32(1)
EPSILON_ = np.float32(EPSILON)


@njit(inline="always")
def _after(index, rows, x, y, z, here):
    """Row of the node at (x, y, z), or `here` for none, which makes the difference 0."""
    if x >= index.shape[0] or y >= index.shape[1] or z >= index.shape[2]:
        return here
    row = row_of(index, rows, x, y, z)
    return row if row >= 0 else here


@njit(parallel=True, fastmath=True, cache=True)
def _vary(chosen, index, rows, values, order, starts, sloped, sums, out):
    """Sums of each slab, and the gradient in `out` (zeros before) where wanted."""
    channels, (_, ny, nz) = values.shape[1], index.shape
    for half in range(2):
        for pair in prange((len(starts) - 1) // 2):
            slab = 2 * pair + half
            total = 0.0
            for j in range(starts[slab], starts[slab + 1]):
                number = chosen[order[j]]
                x, y, z = number // (ny * nz), number // nz % ny, number % nz
                here = row_of(index, rows, x, y, z)
                if here < 0:
                    continue
                right = _after(index, rows, x + 1, y, z, here)
                down = _after(index, rows, x, y + 1, z, here)
                ahead = _after(index, rows, x, y, z + 1, here)
                for c in range(channels):
                    value = values[here, c]
                    dx, dy, dz = values[right, c] - value, values[down, c] - value, values[ahead, c] - value
                    length = np.sqrt(dx * dx + dy * dy + dz * dz + EPSILON_)
                    total += length
                    if sloped:
                        per = ONE / length
                        out[here, c] -= per * (dx + dy + dz)
                        out[right, c] += per * dx
                        out[down, c] += per * dy
                        out[ahead, c] += per * dz
            sums[slab] = total


def forward(ctx, chosen, nodes, values):
    index, rows = nodes.index.numpy(), nodes.rows.numpy()
    first = (chosen // (index.shape[1] * index.shape[2])).to(torch.int32)
    order, starts = slabs_of(first.numpy(), index.shape[0])
    sloped, ctx.count = ctx.needs_input_grad[2], max(len(chosen), 1)
    slope, sums = torch.zeros(values.shape if sloped else (0, 0)), np.zeros(len(starts) - 1)
    _vary(chosen.numpy(), index, rows, values.detach().numpy(), order, starts, sloped, sums, slope.numpy())
    ctx.save_for_backward(slope)
    return torch.tensor(sums.sum() / ctx.count, dtype=torch.float32)


def backward(ctx, grad):
    (slope,) = ctx.saved_tensors
    return None, None, slope * (grad / ctx.count)


run = differentiable(forward, backward)
