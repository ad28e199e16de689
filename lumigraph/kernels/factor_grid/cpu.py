"""Numba. Components are lanes: sixteen of them lie side by side at each node, and a node is one line of the cache.

Forward, threads share the points. For gradients they share planes, components, and bands of a plane's rows, so that no
two threads add to one place. A band adds the samples in their order, so the sum is the same for any number of threads.
"""

import numpy as np
import torch
from numba import njit, prange

from .._lanes import LANES, fetch, put, totals
from .._operation import differentiable, empty
from . import MODES

# All but "reassoc": sums over corners stay in their order.
FAST = {"parallel": True, "fastmath": {"nnan", "ninf", "nsz", "arcp", "contract", "afn"}, "cache": True}
ZERO, ONE = np.float32(0), np.float32(1)
NONE = np.zeros(LANES, np.float32)
SHARE = 1 << 10  # samples that a thread takes at a time
BANDS = 4  # of a plane's rows, with about as many samples in each; parts of all samples for lines alone
AXES = np.array(MODES)


@njit(inline="always")
def _place(x, n):
    """Node below a coordinate in [0, 1], and the fraction towards the next one."""
    s = min(max(x, ZERO), ONE) * np.float32(n - 1)
    node = max(min(np.int64(s), n - 2), 0)  # also where x is no number
    return node, s - np.float32(node)


@njit(inline="always")
def _on_line(table, at, width, f):
    return fetch(table, at) * (ONE - f) + fetch(table, at + width) * f


@njit(inline="always")
def _on_plane(table, at, down, width, f, g):
    """Bilinear interpolation in a plane. down, width: strides of its axes; f, g: fractions along both"""
    return _on_line(table, at, width, g) * (ONE - f) + _on_line(table, at + down, width, g) * f


@njit(inline="always")
def _add(table, at, x):
    put(table, at, fetch(table, at) + x)


@njit(**FAST)
def _look_up(points, table, nodes, starts, vm, width, summed, out):
    n, (nx, ny, nz) = len(points), nodes
    for share in prange((n + SHARE - 1) // SHARE):
        scratch = np.empty(LANES, np.float32)
        for i in range(share * SHARE, min(n, (share + 1) * SHARE)):
            x, fx = _place(points[i, 0], nx)
            y, fy = _place(points[i, 1], ny)
            z, fz = _place(points[i, 2], nz)
            along_x, along_y, along_z = starts[-3] + x * width, starts[-2] + y * width, starts[-1] + z * width
            total = fetch(NONE, 0)
            for c in range(0, width, LANES):
                a = _on_line(table, along_x + c, width, fx)
                b = _on_line(table, along_y + c, width, fy)
                d = _on_line(table, along_z + c, width, fz)
                if vm:
                    a = a * _on_plane(table, starts[0] + (y * nz + z) * width + c, nz * width, width, fy, fz)
                    b = b * _on_plane(table, starts[1] + (x * nz + z) * width + c, nz * width, width, fx, fz)
                    d = d * _on_plane(table, starts[2] + (x * ny + y) * width + c, ny * width, width, fx, fy)
                    if summed:
                        total = total + a + b + d
                    else:
                        at = i * 3 * width + c
                        put(out, at, a)
                        put(out, at + width, b)
                        put(out, at + 2 * width, d)
                elif summed:
                    total = total + a * b * d
                else:
                    put(out, i * width + c, a * b * d)
            if summed:
                put(scratch, 0, totals((total,)))
                out[i] = scratch[0]


@njit(**FAST)
def _places(points, nodes, cells, fractions):
    """`_place` of all points along each axis, kept for the backward passes."""
    for share in prange((len(points) + SHARE - 1) // SHARE):
        for i in range(share * SHARE, min(len(points), (share + 1) * SHARE)):
            for axis in range(3):
                cells[axis, i], fractions[axis, i] = _place(points[i, axis], nodes[axis])


@njit(inline="always")
def _slope(grad, i, at, summed):
    return fetch(NONE, 0) + grad[i] if summed else fetch(grad, at)


@njit(**FAST)
def _spread_planes(grad, cells, fractions, table, nodes, starts, axes, edges, width, summed, out, sums):
    """Gradients of planes into `out`, and of lines into `sums` (band, row of the lines, width), summed per band's
    samples.

    A sample belongs to the band of the first of its two rows; the next band adds to the second row if it owns that.
    """
    chunks, samples = width // LANES, cells.shape[1]
    for unit in prange(3 * chunks * BANDS):
        mode, c, band = unit // (chunks * BANDS), unit // BANDS % chunks * LANES, unit % BANDS
        first, second, beside = axes[mode]
        begin, end = edges[mode, band], edges[mode, band + 1]
        down, start, along = nodes[second] * width, starts[mode], starts[3 + beside]
        mine = starts[3 + beside] - starts[3] + band * sums.size // BANDS + c
        for row in range(begin, end):
            for at in range(start + row * down + c, start + (row + 1) * down, width):
                put(out, at, fetch(NONE, 0))
        for i in range(samples):
            row = cells[first, i]
            if row + 1 < begin or row >= end or (summed and grad[i] == ZERO):
                continue
            column, node = cells[second, i], cells[beside, i]
            f, g, h = fractions[first, i], fractions[second, i], fractions[beside, i]
            at, on = start + row * down + column * width + c, along + node * width + c
            slope = _slope(grad, i, (i * 3 + mode) * width + c, summed)
            to_plane = slope * _on_line(table, on, width, h)
            if row >= begin:
                to_line = slope * _on_plane(table, at, down, width, f, g)
                _add(sums, mine + node * width, to_line * (ONE - h))
                _add(sums, mine + (node + 1) * width, to_line * h)
                _add(out, at, to_plane * ((ONE - f) * (ONE - g)))
                _add(out, at + width, to_plane * ((ONE - f) * g))
            if row + 1 < end:
                _add(out, at + down, to_plane * (f * (ONE - g)))
                _add(out, at + down + width, to_plane * (f * g))


@njit(**FAST)
def _spread_lines(grad, cells, fractions, table, starts, width, summed, sums):
    """Gradients of lines, summed over each part of the samples: sums (part, row, width)."""
    samples = cells.shape[1]
    for part in prange(BANDS):
        mine = part * sums.size // BANDS
        for i in range(part * samples // BANDS, (part + 1) * samples // BANDS):
            at_x, fx = starts[0] + cells[0, i] * width, fractions[0, i]
            at_y, fy = starts[1] + cells[1, i] * width, fractions[1, i]
            at_z, fz = starts[2] + cells[2, i] * width, fractions[2, i]
            for c in range(0, width, LANES):
                slope = _slope(grad, i, i * width + c, summed)
                a = _on_line(table, at_x + c, width, fx)
                b = _on_line(table, at_y + c, width, fy)
                d = _on_line(table, at_z + c, width, fz)
                to_x, to_y, to_z = slope * b * d, slope * a * d, slope * a * b
                _add(sums, mine + at_x + c, to_x * (ONE - fx))
                _add(sums, mine + at_x + c + width, to_x * fx)
                _add(sums, mine + at_y + c, to_y * (ONE - fy))
                _add(sums, mine + at_y + c + width, to_y * fy)
                _add(sums, mine + at_z + c, to_z * (ONE - fz))
                _add(sums, mine + at_z + c + width, to_z * fz)


def forward(ctx, points, table, factors, summed):
    width = table.shape[1]
    starts = np.cumsum([0, *factors.sizes[:-1]]) * width
    found = empty(len(points), 1 if summed else factors.products * width)
    vm = factors.kind == "vm"
    _look_up(_flat(points, 2), _flat(table), np.array(factors.nodes), starts, vm, width, summed, _flat(found))
    ctx.save_for_backward(points, table)
    ctx.about = factors, starts, summed
    return found


def backward(ctx, grad):
    points, table = ctx.saved_tensors
    factors, starts, summed = ctx.about
    nodes, width = np.array(factors.nodes), table.shape[1]
    cells, fractions = np.empty((3, len(points)), np.int64), np.empty((3, len(points)), np.float32)
    _places(_flat(points, 2), nodes, cells, fractions)
    found, lines = empty(*table.shape), sum(factors.sizes[-3:])
    sums = torch.zeros(BANDS, lines, width)
    given = _flat(grad), cells, fractions, _flat(table)
    if factors.kind == "vm":
        edges = np.stack([_bands(cells[axes[0]], nodes[axes[0]]) for axes in MODES])
        _spread_planes(*given, nodes, starts, AXES, edges, width, summed, _flat(found), _flat(sums))
    else:
        _spread_lines(*given, starts, width, summed, _flat(sums))
    torch.sum(sums, 0, out=found[-lines:])
    return None, found, None, None


_factor_grid = differentiable(forward, backward)


def _bands(rows, count):
    """Bounds of bands of rows with about as many samples each."""
    below = np.bincount(rows, minlength=count).cumsum()
    inner = np.searchsorted(below, below[-1] * np.arange(1, BANDS) / BANDS, side="right")
    return np.array([0, *inner.clip(0, count), count])


def _flat(x, axes=1):
    x = x.detach()
    return (x.reshape(-1) if axes == 1 else x).numpy()


def run(points, table, factors, summed):
    """Evaluate with whole vectors of components: a table of other width is padded with zeros."""
    width = table.shape[1]
    table = torch.nn.functional.pad(table, (0, -width % LANES)) if width % LANES else table
    found = _factor_grid(points, table, factors, summed)
    if summed or width == table.shape[1]:
        return found
    return found.view(len(points), factors.products, table.shape[1])[:, :, :width].flatten(1)
