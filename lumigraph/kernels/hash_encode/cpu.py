"""Numba. Work goes level by level, so that one level's table stays in cache. Features are stored in planes (feature,
sample), the layout for matrix products. Forward, threads share the points. For gradients they share the levels, so
that no two threads add to one place and the sum is the same every time.

Before many points are looked up, a level is read once in order: random reads from main memory are slower."""

from functools import cache

import numpy as np
from numba import get_num_threads, njit, prange

from .._lanes import (
    LANES,
    SIXTEEN,
    ahead,
    fetch,
    fetch_like,
    filled,
    gather,
    highest,
    lowest,
    put,
    real,
    scatter,
    whole,
)
from .._operation import differentiable, empty
from ..sparse_grid.cpu import cell_of
from . import PRIMES

P1, P2 = np.uint32(PRIMES[1]), np.uint32(PRIMES[2])
ZERO, ONE = np.float32(0), np.float32(1)
BLOCK = 64  # points whose corners are worked out together; entries and weights are laid out corner by corner
PASS = 64  # entries of a level, for each point looked up, up to which it is read in order first
CHUNK = 1 << 16  # points a thread takes at most at a time: many, so that a level's table is fetched once


@njit(inline="always")
def _along(points, at, resolution):
    """Along one axis: the cells of sixteen points, and the interpolation weights of their two sides."""
    x = lowest(highest(fetch(points, at), ZERO), ONE) * np.float32(resolution)
    cell = lowest(whole(x), np.uint32(resolution - 1))
    share = x - real(cell)
    return cell, ONE - share, share


@njit(inline="always")
def _added(x, y, z, mask):
    return x + y + z


@njit(inline="always")
def _hashed(x, y, z, mask):
    return (x ^ y ^ z) & mask


@njit(inline="always")
def _corners(points, n, at, resolution, step_y, step_z, join, mask, base, features, entries, weights, i):
    """Index of the first feature, and trilinear weight, of the corners around sixteen points, from point `at` on.

    step_y, step_z: strides of an entry's number along y and z (factors, where hashed)
    Written to [corner BLOCK + i] and on. Lanes beyond the last point are undefined.
    """
    x, u0, u1 = _along(points, at, resolution)
    y, v0, v1 = _along(points, n + at, resolution)
    z, w0, w1 = _along(points, 2 * n + at, resolution)
    y, z = y * step_y, z * step_z
    for corner in range(8):
        entry = join(
            x + np.uint32(1) if corner & 1 else x,
            y + step_y if corner & 2 else y,
            z + step_z if corner & 4 else z,
            mask,
        )
        put(entries, corner * BLOCK + i, (entry + np.uint32(base)) * np.uint32(len(features)))
        weight = (u1 if corner & 1 else u0) * ((v1 if corner & 2 else v0) * (w1 if corner & 4 else w0))
        put(weights, corner * BLOCK + i, weight)


@njit(inline="always")
def _place(points, n, first, count, resolution, mask, base, features, entries, weights):
    """Entries and weights of the eight corners around each of `count` points."""
    row = np.uint32(resolution + 1)
    for i in range(0, count, LANES):
        if mask:
            _corners(points, n, first + i, resolution, P1, P2, _hashed, mask, base, features, entries, weights, i)
        else:
            _corners(
                points, n, first + i, resolution, row, row * row, _added, mask, base, features, entries, weights, i
            )


@njit(inline="always")
def blend(table, entries, weights, i, features, out, at, stride):
    """Point i's sum over corners of weight times entry, written in steps of `stride` from out[at] on.

    All features of an entry are one register, so that there are eight loads and eight multiply-adds for any number.
    """
    total = weights[i] * fetch_like(table, entries[i], features)
    for corner in range(1, 8):
        k = corner * BLOCK + i
        total = total + weights[k] * fetch_like(table, entries[k], features)
    scatter(out, at, stride, total)


@njit(inline="always")
def spread(grad, at, stride, entries, weights, i, features, table):
    """Backward of `blend`: add the gradient times its weight to each corner's entry."""
    g = gather(grad, at, stride, features)
    for corner in range(8):
        k = corner * BLOCK + i
        put(table, entries[k], fetch_like(table, entries[k], features) + weights[k] * g)


@njit(inline="always")
def _pass_over(table, first, last):
    """Prefetch a level's entries: reading in order fills the caches faster than random reads.

    The returned sum keeps the compiler from dropping the loop.
    """
    total = filled(ZERO, SIXTEEN)
    for at in range(first, last - LANES + 1, LANES):
        total = total + fetch(table, at)
    return total


@njit(parallel=True, fastmath=True, cache=True)
def _look_up(points, n, table, resolutions, offsets, masks, features, out, share):
    width = len(features)
    for chunk in prange((n + share - 1) // share):
        entries, weights = np.empty(8 * BLOCK, np.uint32), np.empty(8 * BLOCK, np.float32)
        last = min(n, (chunk + 1) * share)
        for level in range(len(resolutions)):
            base, plane = offsets[level], level * width * n
            if PASS * (last - chunk * share) >= offsets[level + 1] - base:
                put(weights, 0, _pass_over(table, base * width, offsets[level + 1] * width))
            for first in range(chunk * share, last, BLOCK):
                count = min(BLOCK, last - first)
                _place(points, n, first, count, resolutions[level], masks[level], base, features, entries, weights)
                for corner in range(8):
                    for i in range(count):
                        ahead(table, entries[corner * BLOCK + i])
                for i in range(count):
                    blend(table, entries, weights, i, features, out, plane + first + i, n)


@njit(parallel=True, fastmath=True, cache=True)
def _table_gradient(grad, points, n, resolutions, offsets, masks, order, features, out):
    width = len(features)
    for slot in prange(len(order)):
        level = order[slot]
        entries, weights = np.empty(8 * BLOCK, np.uint32), np.empty(8 * BLOCK, np.float32)
        base, plane = offsets[level], level * width * n
        out[base * width : offsets[level + 1] * width] = 0
        for first in range(0, n, BLOCK):
            count = min(BLOCK, n - first)
            _place(points, n, first, count, resolutions[level], masks[level], base, features, entries, weights)
            for i in range(count):
                spread(grad, plane + first + i, n, entries, weights, i, features, out)


@njit(parallel=True, fastmath=True, cache=True)
def _point_gradient(grad, points, table, resolutions, offsets, masks, out):
    """Gradient of points: derivative of each level's trilinear interpolation along each axis."""
    features = table.shape[1]
    for i in prange(points.shape[1]):
        slope = np.zeros(3, np.float32)
        for level in range(len(resolutions)):
            resolution, mask = resolutions[level], masks[level]
            row = np.uint32(resolution + 1)
            step_y = P1 if mask else row
            step_z = P2 if mask else np.uint32(row * row)
            cx, fx = cell_of(points[0, i], resolution)
            cy, fy = cell_of(points[1, i], resolution)
            cz, fz = cell_of(points[2, i], resolution)
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


def forward(ctx, points, table, levels):
    n, flat, table = len(points), _planes(points.detach()), table.contiguous()
    ctx.levels = levels
    ctx.save_for_backward(flat, table)
    out = empty(levels.levels * levels.features, n)
    share = max(BLOCK, min(CHUNK, -(-n // get_num_threads())))
    _look_up(flat.numpy(), n, table.detach().numpy().reshape(-1), *_grid(levels), out.numpy().reshape(-1), share)
    return out.t()


def backward(ctx, grad):
    flat, table = ctx.saved_tensors
    *grid, features = _grid(ctx.levels)
    grad, n = grad.t().contiguous().numpy(), len(grad)
    to_points = to_table = None
    if ctx.needs_input_grad[0]:
        to_points = empty(3, n)
        points = flat[: 3 * n].view(3, n).numpy()
        _point_gradient(grad, points, table.detach().numpy(), *grid, to_points.numpy())
        to_points = to_points.t()
    if ctx.needs_input_grad[1]:
        to_table = empty(*table.shape)
        order = _shared_out(ctx.levels.levels, get_num_threads())
        given = grad.reshape(-1), flat.numpy(), n, *grid, order, features
        _table_gradient(*given, to_table.numpy().reshape(-1))
    return to_points, to_table, None


run = differentiable(forward, backward, contiguous=False)


def _planes(points):
    """Points as planes of x, y and z, padded by as much as lanes may read beyond the end."""
    n = len(points)
    flat = empty(3 * n + LANES)
    flat[: 3 * n].view(3, n).copy_(points.t())
    flat[3 * n :] = 0
    return flat


@cache
def _shared_out(levels, threads):
    """Order of levels that balances the threads' consecutive shares between fine and coarse ones."""
    return np.concatenate([np.arange(t, levels, threads) for t in range(threads)])
