"""Numba: a thread takes a few samples through all layers before the next, so that activations stay in the L1 cache.

Backward recomputes the hidden layers: that is cheaper than loading them.
"""

import numpy as np
import torch
from numba import get_num_threads, njit, prange

from .._lanes import LANES, SIXTEEN, ahead, fetch, fetch_like, filled, highest, put, turn, where
from .._operation import differentiable, empty

FAST = {"cache": True, "fastmath": True, "error_model": "numpy"}
BLOCK = 32  # samples, whose values of one feature are lanes; a buffer has feature f of sample s at [f BLOCK + s]
TILE = 4  # outputs that are summed up together: with LANES samples each, sums fill half of sixteen registers
ROW = (0,) * BLOCK
ZERO = np.float32(0)


@njit(inline="always")
def _row(block, f):
    return fetch_like(block, f * BLOCK, ROW)


@njit(inline="always")
def _as_it_is(total, block, gate):
    return total


@njit(inline="always")
def _rectified(total, block, gate):
    return highest(total, ZERO)


@njit(inline="always")
def _gated(total, block, gate):
    return where(fetch(block, gate) > ZERO, total, ZERO)


@njit(inline="always")
def _added(total, block, gate):
    return total + fetch(block, gate)


@njit(inline="always")
def _four(values, x, depth, weights, w, down, across, out, y, gate, finish):
    """`_product` of four outputs for sixteen samples, whose sums stay in registers."""
    a = b = c = d = filled(ZERO, SIXTEEN)
    for i in range(depth):
        value, k = fetch(values, x + BLOCK * i), w + down * i
        a = a + weights[np.uint64(k)] * value
        b = b + weights[np.uint64(k + across)] * value
        c = c + weights[np.uint64(k + 2 * across)] * value
        d = d + weights[np.uint64(k + 3 * across)] * value
    put(out, y, finish(a, out, gate))
    put(out, y + BLOCK, finish(b, out, gate + BLOCK))
    put(out, y + 2 * BLOCK, finish(c, out, gate + 2 * BLOCK))
    put(out, y + 3 * BLOCK, finish(d, out, gate + 3 * BLOCK))


@njit(inline="always")
def _product(values, x, depth, weights, w, down, across, count, out, y, gate, finish):
    """y_o = finish(sum_i w_io x_i, gate_o) for `count` outputs o.

    x_i is row x + i of `values`, y_o row y + o and gate_o row gate + o of `out`;
    w_io is number w + down i + across o of `weights`.
    """
    whole = count - count % TILE
    for s in range(0, BLOCK, LANES):
        at = x * BLOCK + s
        for o in range(0, whole, TILE):
            to, by = (y + o) * BLOCK + s, (gate + o) * BLOCK + s
            _four(values, at, depth, weights, w + across * o, down, across, out, to, by, finish)
        for o in range(whole, count):
            total = filled(ZERO, SIXTEEN)
            for i in range(depth):
                total = total + weights[np.uint64(w + down * i + across * o)] * fetch(values, at + BLOCK * i)
            put(out, (y + o) * BLOCK + s, finish(total, out, (gate + o) * BLOCK + s))


@njit(inline="always")
def _fetch(planes, n, features, first, count, block, row):
    """Copy samples first to first + count of all features into a block's rows, padded with zeros."""
    for f in range(features):
        if count == BLOCK:
            put(block, (row + f) * BLOCK, fetch_like(planes, f * n + first, ROW))
            for s in range(0, BLOCK, LANES):
                ahead(planes, min(f * n + first + BLOCK + s, len(planes) - 1))
        else:
            block[(row + f) * BLOCK : (row + f + 1) * BLOCK] = 0
            for s in range(count):
                block[(row + f) * BLOCK + s] = planes[f * n + first + s]


@njit(inline="always")
def _deliver(block, row, features, planes, n, first, count):
    for f in range(features):
        if count == BLOCK:
            put(planes, f * n + first, _row(block, row + f))
        else:
            for s in range(count):
                planes[f * n + first + s] = block[(row + f) * BLOCK + s]


@njit(inline="always")
def _upwards(block, weights, widths, rows, last):
    """Forward pass of one block; the network's last layer has no ReLU."""
    begin = 0
    for layer in range(last):
        depth, across, x, y = widths[layer], widths[layer + 1], rows[layer], rows[layer + 1]
        if layer < len(widths) - 2:
            _product(block, x, depth, weights, begin, 1, depth, across, block, y, y, _rectified)
        else:
            _product(block, x, depth, weights, begin, 1, depth, across, block, y, y, _as_it_is)
        begin += depth * across


@njit(inline="always")
def _downwards(block, weights, begin, depth, across, slope, target, gate, ungated):
    """Gradient of one layer's inputs from that of its outputs."""
    if ungated:
        _product(block, slope, depth, weights, begin, across, 1, across, block, target, target, _as_it_is)
    else:
        _product(block, slope, depth, weights, begin, across, 1, across, block, target, gate, _gated)


@njit(inline="always")
def _correlate(block, x, depth, slope, across, spare, sums, row):
    """Add one layer's weight gradient, sum_s slope_os x_is. `sums` has BLOCK inputs i of output o in a row."""
    for i in range(0, depth, BLOCK):
        for down in range(0, BLOCK, LANES):
            for right in range(0, BLOCK, LANES):
                turn(block, (x + i + down) * BLOCK + right, (spare + right) * BLOCK + down, BLOCK)
        _product(block, spare, BLOCK, block, slope * BLOCK, 1, BLOCK, across, sums, row, row, _added)
        row += across


@njit(parallel=True, **FAST)
def _forward(x, n, weights, widths, rows, share, out):
    layers = len(widths) - 1
    for part in prange((n + share - 1) // share):
        block = np.empty(rows[-1] * BLOCK, np.float32)
        stop = min(n, (part + 1) * share)
        for first in range(part * share, stop, BLOCK):
            count = min(BLOCK, stop - first)
            _fetch(x, n, widths[0], first, count, block, 0)
            _upwards(block, weights, widths, rows, layers)
            _deliver(block, rows[layers], widths[layers], out, n, first, count)


@njit(parallel=True, **FAST)
def _backward(grad, x, n, weights, widths, rows, share, inputs, to_x, sums):
    """Gradients. A block has each layer's values, then each layer's gradients, then scratch memory of `_correlate`.

    inputs: number of the network's inputs with a gradient, all or none
    sums: one for each part; those of a layer's weights for BLOCK inputs follow those of all layers before it
    """
    layers, total = len(widths) - 1, rows[-1]
    for part in prange((n + share - 1) // share):
        block = np.zeros((2 * total + 3 * BLOCK) * BLOCK, np.float32)
        mine = np.zeros(sums.shape[1], np.float32)
        stop = min(n, (part + 1) * share)
        for first in range(part * share, stop, BLOCK):
            count = min(BLOCK, stop - first)
            _fetch(x, n, widths[0], first, count, block, 0)
            _upwards(block, weights, widths, rows, layers - 1)
            _fetch(grad, n, widths[layers], first, count, block, total + rows[layers])
            begin, row = len(weights), len(mine) // BLOCK
            for layer in range(layers - 1, -1, -1):
                depth, across = widths[layer], widths[layer + 1]
                slope, target = total + rows[layer + 1], total + rows[layer]
                begin -= depth * across
                row -= (depth + BLOCK - 1) // BLOCK * across
                _correlate(block, rows[layer], depth, slope, across, 2 * total + BLOCK, mine, row)
                if layer or inputs:
                    _downwards(block, weights, begin, across, depth, slope, target, rows[layer], layer == 0)
            _deliver(block, total, inputs, to_x, n, first, count)
        sums[part] = mine


def forward(ctx, x, *weights):
    planes = x.detach().t().contiguous()
    out = empty(len(weights[-1]), len(x))
    _forward(planes.numpy().reshape(-1), len(x), *_shape(weights), _share(len(x)), out.numpy().reshape(-1))
    ctx.save_for_backward(planes, *weights)
    return out.t()


def backward(ctx, grad):
    x, *weights = ctx.saved_tensors
    n, share, shape = x.shape[1], _share(x.shape[1]), _shape(weights)
    to_x = empty(len(x) if ctx.needs_input_grad[0] else 0, n)
    heights = [-(-w.shape[1] // BLOCK) * len(w) for w in weights]
    sums = torch.zeros(max(1, -(-n // share)), sum(heights) * BLOCK)
    given = grad.t().contiguous().numpy().reshape(-1), x.numpy().reshape(-1), n, *shape, share, len(to_x)
    _backward(*given, to_x.numpy().reshape(-1), sums.numpy())
    to_weights = [
        part.view(-1, len(w), BLOCK).transpose(0, 1).reshape(len(w), -1)[:, : w.shape[1]]
        for part, w in zip(sums.sum(0).view(-1, BLOCK).split(heights), weights, strict=True)
    ]
    return (to_x.t() if len(to_x) else None), *to_weights


_perceptron = differentiable(forward, backward, contiguous=False)


def _shape(weights):
    """All weights concatenated; each layer's width; the first row of each layer's values."""
    flat = torch.cat([w.detach().reshape(-1) for w in weights]).numpy()
    widths = np.array([weights[0].shape[1], *(len(w) for w in weights)])
    return flat, widths, np.concatenate([[0], widths.cumsum()])


def _share(n):
    """Samples per thread, a multiple of the block size."""
    return max(BLOCK, -(-n // (get_num_threads() * BLOCK)) * BLOCK)


def run(x, weights):
    return _perceptron(x, *weights)
