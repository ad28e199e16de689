"""Numba: a thread takes a few samples through all layers before the next, so that nothing leaves its nearest cache.

On the way back the hidden layers are worked out again rather than kept: that is cheaper than fetching them.
"""

import numpy as np
import torch
from numba import get_num_threads, njit, prange

from .._dispatch import empty
from .lanes import BLOCK, TILE, added, gated, move, product, rectified, transpose

FAST = {"cache": True, "fastmath": True, "error_model": "numpy"}
WIDE, NARROW = (0,) * TILE, (0,)  # their lengths tell the compiler how many outputs go together


@njit(inline="always")
def _fetch(planes, features, first, count, block, row):
    """Samples first to first + count of all features, into a block's rows; zeros after them."""
    for f in range(features):
        if count == BLOCK:
            move(planes, f * planes.shape[1] + first, block, (row + f) * BLOCK)
        else:
            block[(row + f) * BLOCK : (row + f + 1) * BLOCK] = 0
            for s in range(count):
                block[(row + f) * BLOCK + s] = planes[f, first + s]


@njit(inline="always")
def _deliver(block, row, features, planes, first, count):
    for f in range(features):
        if count == BLOCK:
            move(block, (row + f) * BLOCK, planes, f * planes.shape[1] + first)
        else:
            for s in range(count):
                planes[f, first + s] = block[(row + f) * BLOCK + s]


@njit(inline="always")
def _upwards(block, weights, widths, rows, last):
    """All layers of one block; the last of the network has no ReLU."""
    begin = 0
    for layer in range(last):
        depth, across = widths[layer], widths[layer + 1]
        x, y, whole = rows[layer], rows[layer + 1], across - across % TILE
        if layer < len(widths) - 2:
            for o in range(0, whole, TILE):
                rectified(block, x, depth, weights, begin + o * depth, 1, depth, block, y + o, y + o, WIDE)
            for o in range(whole, across):
                rectified(block, x, depth, weights, begin + o * depth, 1, depth, block, y + o, y + o, NARROW)
        else:
            for o in range(0, whole, TILE):
                product(block, x, depth, weights, begin + o * depth, 1, depth, block, y + o, y + o, WIDE)
            for o in range(whole, across):
                product(block, x, depth, weights, begin + o * depth, 1, depth, block, y + o, y + o, NARROW)
        begin += depth * across


@njit(inline="always")
def _downwards(block, weights, begin, depth, across, slope, target, gate, ungated):
    """The gradient of one layer's inputs from that of its outputs."""
    whole = across - across % TILE
    if ungated:
        for i in range(0, whole, TILE):
            product(block, slope, depth, weights, begin + i, across, 1, block, target + i, target + i, WIDE)
        for i in range(whole, across):
            product(block, slope, depth, weights, begin + i, across, 1, block, target + i, target + i, NARROW)
    else:
        for i in range(0, whole, TILE):
            gated(block, slope, depth, weights, begin + i, across, 1, block, target + i, gate + i, WIDE)
        for i in range(whole, across):
            gated(block, slope, depth, weights, begin + i, across, 1, block, target + i, gate + i, NARROW)


@njit(inline="always")
def _correlate(block, x, depth, slope, across, spare, sums, row):
    """Add one layer's weight gradient: sum_s slope_os x_is. `sums` holds BLOCK inputs i of output o in a row."""
    whole = across - across % TILE
    for i in range(0, depth, BLOCK):
        transpose(block, x + i, spare)
        for o in range(0, whole, TILE):
            added(block, spare, BLOCK, block, (slope + o) * BLOCK, 1, BLOCK, sums, row + o, row + o, WIDE)
        for o in range(whole, across):
            added(block, spare, BLOCK, block, (slope + o) * BLOCK, 1, BLOCK, sums, row + o, row + o, NARROW)
        row += across


@njit(parallel=True, **FAST)
def _forward(x, weights, widths, rows, share, out):
    n, layers = x.shape[1], len(widths) - 1
    for part in prange((n + share - 1) // share):
        block = np.empty(rows[-1] * BLOCK, np.float32)
        stop = min(n, (part + 1) * share)
        for first in range(part * share, stop, BLOCK):
            count = min(BLOCK, stop - first)
            _fetch(x, widths[0], first, count, block, 0)
            _upwards(block, weights, widths, rows, layers)
            _deliver(block, rows[layers], widths[layers], out, first, count)


@njit(parallel=True, **FAST)
def _backward(grad, x, weights, widths, rows, share, to_x, sums):
    """A block holds each layer's values, then each layer's gradients, then what `_correlate` turns over.

    sums: one for each part; those of a layer's weights for BLOCK inputs follow those of all layers before it
    """
    n, layers, total = x.shape[1], len(widths) - 1, rows[-1]
    for part in prange((n + share - 1) // share):
        block = np.zeros((2 * total + 3 * BLOCK) * BLOCK, np.float32)
        mine = np.zeros(sums.shape[1], np.float32)
        stop = min(n, (part + 1) * share)
        for first in range(part * share, stop, BLOCK):
            count = min(BLOCK, stop - first)
            _fetch(x, widths[0], first, count, block, 0)
            _upwards(block, weights, widths, rows, layers - 1)
            _fetch(grad, widths[layers], first, count, block, total + rows[layers])
            begin, row = len(weights), len(mine) // BLOCK
            for layer in range(layers - 1, -1, -1):
                depth, across = widths[layer], widths[layer + 1]
                slope, target = total + rows[layer + 1], total + rows[layer]
                begin -= depth * across
                row -= (depth + BLOCK - 1) // BLOCK * across
                _correlate(block, rows[layer], depth, slope, across, 2 * total + BLOCK, mine, row)
                if layer or len(to_x):
                    _downwards(block, weights, begin, across, depth, slope, target, rows[layer], layer == 0)
            _deliver(block, total, len(to_x), to_x, first, count)
        sums[part] = mine


class _Perceptron(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, *weights):
        planes = x.detach().t().contiguous()
        shape = _shape(weights)
        out = empty(len(weights[-1]), len(x))
        _forward(planes.numpy(), *shape, _share(len(x)), out.numpy())
        ctx.save_for_backward(planes, *weights)
        return out.t()

    @staticmethod
    def backward(ctx, grad):
        x, *weights = ctx.saved_tensors
        flat, widths, rows = _shape(weights)
        n, share = x.shape[1], _share(x.shape[1])
        to_x = empty(len(x) if ctx.needs_input_grad[0] else 0, n)
        heights = [-(-w.shape[1] // BLOCK) * len(w) for w in weights]
        sums = torch.zeros(max(1, -(-n // share)), sum(heights) * BLOCK)
        _backward(grad.t().contiguous().numpy(), x.numpy(), flat, widths, rows, share, to_x.numpy(), sums.numpy())
        parts = sums.sum(0).view(-1, BLOCK).split(heights)
        to_weights = [
            part.view(-1, len(w), BLOCK).transpose(0, 1).reshape(len(w), -1)[:, : w.shape[1]]
            for part, w in zip(parts, weights, strict=True)
        ]
        return (to_x.t() if len(to_x) else None), *to_weights


def _shape(weights):
    """All weights end to end; each layer's width; the first row of each layer's values, one below the other."""
    flat = torch.cat([w.detach().reshape(-1) for w in weights]).numpy()
    widths = np.array([weights[0].shape[1], *(len(w) for w in weights)])
    return flat, widths, np.concatenate([[0], widths.cumsum()])


def _share(n):
    """Samples per thread, whole blocks of them."""
    return max(BLOCK, -(-n // (get_num_threads() * BLOCK)) * BLOCK)


def run(x, weights):
    return _Perceptron.apply(x, *weights)
