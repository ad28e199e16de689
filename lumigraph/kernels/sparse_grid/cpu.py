"""Numba. Forward, threads share the samples. For gradients they share slabs of the grid: first every other one, then
those between, so that no two threads add to one node and the sum is the same every time."""

import numpy as np
import torch
from numba import njit, prange

from .._operation import differentiable, empty

ZERO, ONE = np.float32(0), np.float32(1)
SLABS = 32  # that a grid is cut into at most, however many threads there are
CHUNK = 1 << 10  # samples a thread takes at a time


@njit(inline="always")
def cell_of(x, cells):
    """Cell and fractional position within it along one axis; clamped to the grid."""
    s = min(max(x, ZERO), ONE) * np.float32(cells)
    cell = min(np.int64(s), np.int64(cells - 1))
    cell = max(cell, np.int64(0))  # also where x is no number
    return cell, s - np.float32(cell)


@njit(inline="always")
def row_of(index, rows, x, y, z):
    """The row of a node, -1 where it has none."""
    row = index[x, y, z]
    return rows[row] if row >= 0 and len(rows) else row


@njit(inline="always")
def corners(points, i, index, rows, at, weights):
    """Rows and trilinear weights of the occupied ones of the eight nodes around sample i; returns their number."""
    cx, fx = cell_of(points[i, 0], index.shape[0] - 1)
    cy, fy = cell_of(points[i, 1], index.shape[1] - 1)
    cz, fz = cell_of(points[i, 2], index.shape[2] - 1)
    count, some = 0, len(rows) > 0
    for x in range(2):
        for y in range(2):
            across = (fx if x else ONE - fx) * (fy if y else ONE - fy)
            line = index[np.uint64(cx + x), np.uint64(cy + y)]
            for z in range(2):
                row = line[np.uint64(cz + z)]
                if some and row >= 0:
                    row = rows[np.uint64(row)]
                at[count] = max(row, np.int32(0))
                weights[count] = across * (fz if z else ONE - fz)
                count += row >= 0
    return count


@njit(cache=True)
def slabs_of(first, cells):
    """Samples sorted by slabs of cells, with about as many samples in each slab.

    first: each sample's cell along x.
    Returns the samples' indices, and the start of each slab; the number of slabs is even.
    """
    counts = np.zeros(cells + 1, np.int64)
    for i in range(len(first)):
        counts[first[i]] += 1
    slab_of, enough, slab, full = np.empty(cells, np.int64), len(first) // SLABS + 1, 0, 0
    for x in range(cells):
        slab_of[x] = slab
        full += counts[x]
        if full >= enough:
            slab, full = slab + 1, 0
    slabs = (slab + 2) // 2 * 2
    starts = np.zeros(slabs + 1, np.int64)
    for x in range(cells):
        starts[slab_of[x] + 1] += counts[x]
    for slab in range(slabs):
        starts[slab + 1] += starts[slab]
    order, ends = np.empty(len(first), np.int32), starts[:-1].copy()
    for i in range(len(first)):
        slab = slab_of[first[i]]
        order[ends[slab]] = i
        ends[slab] += 1
    return order, starts


@njit(parallel=True, cache=True)
def first_cells(points, cells, out):
    """Each sample's cell along x."""
    for i in prange(len(points)):
        out[i] = cell_of(points[i, 0], cells)[0]


def in_slabs(points, index):
    """Samples by slabs; see `slabs_of`."""
    first = np.empty(len(points), np.int32)
    first_cells(points, index.shape[0] - 1, first)
    return slabs_of(first, index.shape[0] - 1)


@njit(parallel=True, fastmath=True, cache=True)
def _look_up(points, index, rows, values, out):
    n, channels = out.shape
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        at, weights = np.empty(9, np.int64), np.empty(9, np.float32)
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            count = corners(points, i, index, rows, at, weights)
            for c in range(channels):
                out[i, c] = ZERO
            for k in range(count):
                row, weight = at[k], weights[k]
                for c in range(channels):
                    out[i, c] += weight * values[row, c]


@njit(parallel=True, fastmath=True, cache=True)
def _look_up_one(points, index, rows, values, out):
    """Look up a single channel."""
    n = len(out)
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        at, weights = np.empty(9, np.int64), np.empty(9, np.float32)
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            total = ZERO
            for k in range(corners(points, i, index, rows, at, weights)):
                total += weights[k] * values[at[k], 0]
            out[i, 0] = total


@njit(parallel=True, fastmath=True, cache=True)
def _value_gradient(grad, points, index, rows, order, starts, out):
    channels = grad.shape[1]
    for half in range(2):
        for pair in prange((len(starts) - 1) // 2):
            slab = 2 * pair + half
            at, weights = np.empty(9, np.int64), np.empty(9, np.float32)
            for j in range(starts[slab], starts[slab + 1]):
                i = order[j]
                for k in range(corners(points, i, index, rows, at, weights)):
                    row, weight = at[k], weights[k]
                    for c in range(channels):
                        out[row, c] += weight * grad[i, c]


@njit(parallel=True, fastmath=True, cache=True)
def _point_gradient(grad, points, index, rows, values, out):
    """Gradient of points: derivative of the interpolation along each axis."""
    channels = grad.shape[1]
    cells = index.shape[0] - 1, index.shape[1] - 1, index.shape[2] - 1
    for i in prange(len(points)):
        cx, fx = cell_of(points[i, 0], cells[0])
        cy, fy = cell_of(points[i, 1], cells[1])
        cz, fz = cell_of(points[i, 2], cells[2])
        sx, sy, sz = ZERO, ZERO, ZERO
        for corner in range(8):
            x, y, z = corner & 1, corner >> 1 & 1, corner >> 2
            row = row_of(index, rows, cx + x, cy + y, cz + z)
            if row >= 0:
                value = ZERO
                for c in range(channels):
                    value += grad[i, c] * values[row, c]
                wx, wy, wz = fx if x else ONE - fx, fy if y else ONE - fy, fz if z else ONE - fz
                sx += value * (2 * x - 1) * wy * wz
                sy += value * (2 * y - 1) * wx * wz
                sz += value * (2 * z - 1) * wx * wy
        out[i, 0] = sx * cells[0] if ZERO <= points[i, 0] <= ONE else ZERO
        out[i, 1] = sy * cells[1] if ZERO <= points[i, 1] <= ONE else ZERO
        out[i, 2] = sz * cells[2] if ZERO <= points[i, 2] <= ONE else ZERO


def forward(ctx, points, nodes, values):
    ctx.nodes = nodes
    ctx.save_for_backward(points, values)
    out = empty(len(points), values.shape[1])
    run = _look_up_one if values.shape[1] == 1 else _look_up
    run(points.detach().numpy(), nodes.index.numpy(), nodes.rows.numpy(), values.detach().numpy(), out.numpy())
    return out


def backward(ctx, grad):
    points, values = (x.detach() for x in ctx.saved_tensors)
    index, rows = ctx.nodes.index.numpy(), ctx.nodes.rows.numpy()
    grad = grad.numpy()
    to_points = to_values = None
    if ctx.needs_input_grad[0]:
        to_points = empty(*points.shape)
        _point_gradient(grad, points.numpy(), index, rows, values.numpy(), to_points.numpy())
    if ctx.needs_input_grad[2]:
        to_values = torch.zeros_like(values)
        order, starts = in_slabs(points.numpy(), index)
        _value_gradient(grad, points.numpy(), index, rows, order, starts, to_values.numpy())
    return to_points, None, to_values


run = differentiable(forward, backward)
