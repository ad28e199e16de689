"""Numba. Work goes level by level, so that one level's table stays in cache, and features are kept in planes (feature,
sample), as a matrix product likes them. Looking up, threads share out the points; spreading gradients, the levels, so
that no two threads add to one place and the sum is the same every time."""

from functools import cache

import numpy as np
import torch
from numba import get_num_threads, njit, prange

from .._dispatch import empty
from .._vectors import LANES
from . import PRIMES
from .lanes import BLOCK, blend, place_dense, place_hashed, spread

P1, P2 = np.uint32(PRIMES[1]), np.uint32(PRIMES[2])
ZERO, ONE = np.float32(0), np.float32(1)
CHUNK = 1 << 16  # points a thread takes at most at a time: many, so that a level's table is fetched once


@njit(inline="always")
def _cell(x, resolution):
    """Cell and place within it along one axis; what lies outside is clamped onto the border."""
    s = min(max(x, ZERO), ONE) * np.float32(resolution)
    cell = min(np.int32(s), np.int32(resolution - 1))
    cell = max(cell, np.int32(0))  # also where x is no number
    return cell, s - np.float32(cell)


@njit(inline="always")
def _place(points, axes, first, count, resolution, mask, base, lanes, entries, weights):
    """The eight corners around each of `count` points: where their features lie, and trilinear weights."""
    row = np.uint32(resolution + 1)
    for i in range(0, count, LANES):
        if mask:
            place_hashed(points, first + i, axes, resolution, P1, P2, mask, base, lanes, entries, weights, i)
        else:
            place_dense(points, first + i, axes, resolution, row, row * row, mask, base, lanes, entries, weights, i)


@njit(parallel=True, fastmath=True, cache=True)
def _look_up(points, table, resolutions, offsets, masks, lanes, out, share):
    n, features = points.shape[1], len(lanes)
    axes = points.strides[0] // 4
    for chunk in prange((n + share - 1) // share):
        entries, weights = np.empty(8 * BLOCK, np.uint32), np.empty(8 * BLOCK, np.float32)
        last = min(n, (chunk + 1) * share)
        for level in range(len(resolutions)):
            base, plane = offsets[level], level * features * n
            for first in range(chunk * share, last, BLOCK):
                count = min(BLOCK, last - first)
                _place(points, axes, first, count, resolutions[level], masks[level], base, lanes, entries, weights)
                for i in range(count):
                    blend(table, entries, weights, i, lanes, out, plane + first + i, n)


@njit(parallel=True, fastmath=True, cache=True)
def _table_gradient(grad, points, resolutions, offsets, masks, order, lanes, out):
    n, features = points.shape[1], len(lanes)
    axes = points.strides[0] // 4
    for slot in prange(len(order)):
        level = order[slot]
        entries, weights = np.empty(8 * BLOCK, np.uint32), np.empty(8 * BLOCK, np.float32)
        base, plane = offsets[level], level * features * n
        out[base : offsets[level + 1]] = 0
        for first in range(0, n, BLOCK):
            count = min(BLOCK, n - first)
            _place(points, axes, first, count, resolutions[level], masks[level], base, lanes, entries, weights)
            for i in range(count):
                spread(grad, plane + first + i, n, entries, weights, i, lanes, out)


@njit(parallel=True, fastmath=True, cache=True)
def _point_gradient(grad, points, table, resolutions, offsets, masks, out):
    """The slope of each level's trilinear blend along each axis: corners' values, signed by side."""
    features = table.shape[1]
    for i in prange(points.shape[1]):
        slope = np.zeros(3, np.float32)
        for level in range(len(resolutions)):
            resolution, mask = resolutions[level], masks[level]
            row = np.uint32(resolution + 1)
            step_y = P1 if mask else row
            step_z = P2 if mask else np.uint32(row * row)
            cx, fx = _cell(points[0, i], resolution)
            cy, fy = _cell(points[1, i], resolution)
            cz, fz = _cell(points[2, i], resolution)
            for corner in range(8):
                bx, by, bz = corner & 1, corner >> 1 & 1, corner >> 2
                x, y = np.uint32(cx + bx), np.uint32(np.uint32(cy + by) * step_y)
                z = np.uint32(np.uint32(cz + bz) * step_z)
                entry = offsets[level] + ((x ^ y ^ z) & mask if mask else x + y + z)
                value = ZERO
                for f in range(features):
                    value += grad[level * features + f, i] * table[entry, f]
                value *= np.float32(resolution)
                wx, wy, wz = fx if bx else ONE - fx, fy if by else ONE - fy, fz if bz else ONE - fz
                slope[0] += value * (2 * bx - 1) * wy * wz
                slope[1] += value * (2 * by - 1) * wx * wz
                slope[2] += value * (2 * bz - 1) * wx * wy
        for axis in range(3):
            out[axis, i] = slope[axis] if ZERO <= points[axis, i] <= ONE else ZERO


@cache
def _grid(levels):
    """Resolution, first entry and hash mask (0: dense) of each level, and a tuple as long as an entry."""
    resolutions = np.array(levels.resolutions)
    dense = (resolutions + 1) ** 3 <= 2**levels.log2_entries
    masks = np.where(dense, 0, 2**levels.log2_entries - 1).astype(np.uint32)
    return resolutions, np.array(levels.offsets), masks, (ONE,) * levels.features


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, points, table, levels):
        planes = _planes(points.detach())
        ctx.levels = levels
        ctx.save_for_backward(planes, table)
        out = empty(levels.levels * levels.features, len(points))
        *grid, lanes = _grid(levels)
        share = max(BLOCK, min(CHUNK, -(-len(points) // get_num_threads())))
        _look_up(planes.numpy(), table.detach().numpy(), *grid, lanes, out.numpy().reshape(-1), share)
        return out.t()

    @staticmethod
    def backward(ctx, grad):
        points, table = ctx.saved_tensors
        resolutions, offsets, masks, lanes = _grid(ctx.levels)
        grad = grad.t().contiguous().numpy()
        to_points = to_table = None
        if ctx.needs_input_grad[0]:
            to_points = empty(*points.shape)
            table_ = table.detach().numpy()
            _point_gradient(grad, points.numpy(), table_, resolutions, offsets, masks, to_points.numpy())
            to_points = to_points.t()
        if ctx.needs_input_grad[1]:
            to_table = empty(*table.shape)
            order = _shared_out(len(resolutions), get_num_threads())
            _table_gradient(
                grad.reshape(-1), points.numpy(), resolutions, offsets, masks, order, lanes, to_table.numpy()
            )
        return to_points, to_table, None


def _planes(points):
    """One axis after another, and as much memory after the last as a vector may reach over the end."""
    n = len(points)
    planes = empty(3 * n + LANES)[: 3 * n].view(3, n)
    return planes.copy_(points.t())


@cache
def _shared_out(levels, threads):
    """Levels in an order that gives each thread's consecutive share fine and coarse ones alike."""
    return np.concatenate([np.arange(t, levels, threads) for t in range(threads)])


def run(points, table, levels):
    return _Encode.apply(points, table.contiguous(), levels)
