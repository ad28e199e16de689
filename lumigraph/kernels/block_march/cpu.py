"""Numba. Threads share out the rays. Backwards, each ray's steps are walked again and noted, its gradients worked out
from the back to the front, and what the steps owe to rows is spread slab by slab, so that no two threads add to one."""

import numpy as np
import torch
from numba import njit, prange

from .._dispatch import empty
from ..sparse_grid.cpu import slabs_of

ZERO, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)
FAR = np.float32(1e30)
CHUNK = 64  # rays a thread takes at a time
C, A = 8, 3  # channels, and which of them is alpha


@njit(inline="always")
def block_of(x, y, z, index, block):
    """The block's coordinates at a place, and its number; -1 beyond the grid and where there is none."""
    wide = np.float32(block)
    bx, by, bz = np.floor((x + HALF) / wide), np.floor((y + HALF) / wide), np.floor((z + HALF) / wide)
    ix, iy, iz = np.int64(bx), np.int64(by), np.int64(bz)
    inside = ix >= 0 and iy >= 0 and iz >= 0 and ix < index.shape[0] and iy < index.shape[1] and iz < index.shape[2]
    number = np.int64(index[ix, iy, iz]) if inside else np.int64(-1)
    return ix, iy, iz, number


@njit(inline="always")
def to_side(x, d, b, block):
    """Distance along a ray to where it leaves block b of one axis."""
    if abs(d) < np.float32(1e-9):
        return FAR
    return (np.float32(block * (b + (d > 0))) - HALF - x) / d


@njit(inline="always")
def beyond(x, y, z, dx, dy, dz, bx, by, bz, block):
    """Steps, one at least, after which a ray has left a block."""
    away = min(to_side(x, dx, bx, block), to_side(y, dy, by, block), to_side(z, dz, bz, block))
    return max(np.int64(1), np.int64(np.ceil(min(away, np.float32(1e9)))))


@njit(inline="always")
def cell_of(x, b, block):
    """Along one axis: the first of the two voxels around a place, counted in its block, and the place beyond it."""
    place = x - np.float32(block * b) + ONE
    cell = min(max(np.int64(place), np.int64(0)), np.int64(block))
    return cell, place - np.float32(cell)


@njit(inline="always")
def onward(row):
    """Steps that an empty voxel's distance leaves empty; 0 where there is something to look up."""
    return np.int64(0) if row >= -1 else np.int64(-1 - row)


@njit(inline="always")
def corners(rows, number, cx, fx, cy, fy, cz, fz, at, weights):
    """Rows and weights of those of the eight voxels that have a row; returns how many there are."""
    count = 0
    for x in range(2):
        for y in range(2):
            across = (fx if x else ONE - fx) * (fy if y else ONE - fy)
            for z in range(2):
                row = rows[number, cx + x, cy + y, cz + z]
                at[count] = max(row, np.int32(0))
                weights[count] = across * (fz if z else ONE - fz)
                count += row >= 0
    return count


@njit(inline="always")
def blended(values, at, weights, count, seen):
    for c in range(C):
        seen[c] = ZERO
    for k in range(count):
        row, weight = at[k], weights[k]
        for c in range(C):
            seen[c] += weight * values[row, c]


@njit(parallel=True, fastmath=True, cache=True)
def _forward(origins, directions, enter, leave, index, rows, values, stop, totals, distance, lengths):
    """lengths: how many steps of each ray met something"""
    n, block = len(origins), rows.shape[1] - 2
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        at, weights = np.empty(9, np.int64), np.empty(9, np.float32)
        seen, total = np.empty(C, np.float32), np.empty(C, np.float32)
        for r in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
            light, along, met, i = ONE, ZERO, 0, np.int64(0)
            for c in range(C):
                total[c] = ZERO
            while True:
                t = enter[r] + np.float32(i)
                if t >= leave[r] or light < stop:
                    break
                x, y, z = origins[r, 0] + t * dx, origins[r, 1] + t * dy, origins[r, 2] + t * dz
                bx, by, bz, number = block_of(x, y, z, index, block)
                if number < 0:
                    i += beyond(x, y, z, dx, dy, dz, bx, by, bz, block)
                    continue
                (cx, fx), (cy, fy), (cz, fz) = cell_of(x, bx, block), cell_of(y, by, block), cell_of(z, bz, block)
                leap = onward(rows[number, cx, cy, cz])
                if leap > 0:
                    i += leap
                    continue
                count = corners(rows, number, cx, fx, cy, fy, cz, fz, at, weights)
                i += 1
                if count == 0:
                    continue
                met += 1
                blended(values, at, weights, count, seen)
                for c in range(C):
                    total[c] += light * seen[c]
                along += light * seen[A] * t
                light *= ONE - seen[A]
            for c in range(C):
                totals[r, c] = total[c]
            distance[r], lengths[r] = along, met


@njit(parallel=True, fastmath=True, cache=True)
def _steps(origins, directions, enter, leave, index, rows, values, stop, starts, steps, lights):
    """The steps of each ray that met something, and the light that reached them."""
    n, block = len(origins), rows.shape[1] - 2
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        at, weights, seen = np.empty(9, np.int64), np.empty(9, np.float32), np.empty(C, np.float32)
        for r in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
            light, s, i = ONE, starts[r], np.int64(0)
            while s < starts[r + 1]:
                t = enter[r] + np.float32(i)
                x, y, z = origins[r, 0] + t * dx, origins[r, 1] + t * dy, origins[r, 2] + t * dz
                bx, by, bz, number = block_of(x, y, z, index, block)
                if number < 0:
                    i += beyond(x, y, z, dx, dy, dz, bx, by, bz, block)
                    continue
                (cx, fx), (cy, fy), (cz, fz) = cell_of(x, bx, block), cell_of(y, by, block), cell_of(z, bz, block)
                leap = onward(rows[number, cx, cy, cz])
                if leap > 0:
                    i += leap
                    continue
                count = corners(rows, number, cx, fx, cy, fy, cz, fz, at, weights)
                i += 1
                if count == 0:
                    continue
                blended(values, at, weights, count, seen)
                steps[s], lights[s] = i - 1, light
                light *= ONE - seen[A]
                s += 1


@njit(parallel=True, fastmath=True, cache=True)
def _owed(
    g_totals, g_distance, origins, directions, enter, index, rows, values, starts, steps, lights, points, first, out
):
    """What each step's blended values owe: dL/dv = T g, and for alpha beside it what it hides of all behind it.

    first: of each step, the first of the two voxels around it along x, counted from the grid's apron
    """
    block = rows.shape[1] - 2
    for r in prange(len(origins)):
        at, weights, seen = np.empty(9, np.int64), np.empty(9, np.float32), np.empty(C, np.float32)
        hidden = ZERO  # sum over steps j behind step i of prod_{i<k<j} (1 - alpha_k) dL/dT_j
        for s in range(starts[r + 1] - 1, starts[r] - 1, -1):
            t = enter[r] + np.float32(steps[s])
            for axis in range(3):
                points[s, axis] = origins[r, axis] + t * directions[r, axis]
            x, y, z = points[s, 0], points[s, 1], points[s, 2]
            bx, by, bz, number = block_of(x, y, z, index, block)
            (cx, fx), (cy, fy), (cz, fz) = cell_of(x, bx, block), cell_of(y, by, block), cell_of(z, bz, block)
            count = corners(rows, max(number, np.int64(0)), cx, fx, cy, fy, cz, fz, at, weights)
            blended(values, at, weights, count, seen)
            first[s] = block * bx + cx
            own = g_distance[r] * seen[A] * t
            for c in range(C):
                own += g_totals[r, c] * seen[c]
                out[s, c] = lights[s] * g_totals[r, c]
            out[s, A] += lights[s] * (g_distance[r] * t - hidden)
            hidden = own + (ONE - seen[A]) * hidden


@njit(parallel=True, fastmath=True, cache=True)
def _spread(owed, points, index, rows, order, starts, out):
    block = rows.shape[1] - 2
    for half in range(2):
        for pair in prange((len(starts) - 1) // 2):
            slab = 2 * pair + half
            at, weights = np.empty(9, np.int64), np.empty(9, np.float32)
            for j in range(starts[slab], starts[slab + 1]):
                s = order[j]
                x, y, z = points[s, 0], points[s, 1], points[s, 2]
                bx, by, bz, number = block_of(x, y, z, index, block)
                (cx, fx), (cy, fy), (cz, fz) = cell_of(x, bx, block), cell_of(y, by, block), cell_of(z, bz, block)
                for k in range(corners(rows, max(number, np.int64(0)), cx, fx, cy, fy, cz, fz, at, weights)):
                    row, weight = at[k], weights[k]
                    for c in range(C):
                        out[row, c] += weight * owed[s, c]


class _BlockMarch(torch.autograd.Function):
    @staticmethod
    def forward(ctx, origins, directions, enter, leave, blocks, values, stop):
        ctx.blocks, ctx.stop = blocks, np.float32(stop)
        totals, distance = empty(len(origins), C), empty(len(origins))
        lengths = torch.zeros(len(origins), dtype=torch.int64)
        given = (x.detach().numpy() for x in (origins, directions, enter, leave, blocks.index, blocks.rows, values))
        _forward(*given, ctx.stop, totals.numpy(), distance.numpy(), lengths.numpy())
        ctx.save_for_backward(origins, directions, enter, leave, values, lengths)
        return totals, distance

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g_totals, g_distance):
        origins, directions, enter, leave, values, lengths = (x.detach().numpy() for x in ctx.saved_tensors)
        index, rows = ctx.blocks.index.numpy(), ctx.blocks.rows.numpy()
        starts = np.concatenate([np.zeros(1, np.int64), lengths.cumsum()])
        total, block = int(starts[-1]), ctx.blocks.block
        steps, first = np.empty(total, np.int32), np.empty(total, np.int32)
        lights, points, owed = empty(total).numpy(), empty(total, 3).numpy(), empty(total, C).numpy()
        _steps(origins, directions, enter, leave, index, rows, values, ctx.stop, starts, steps, lights)
        grads = g_totals.contiguous().numpy(), g_distance.contiguous().numpy()
        _owed(*grads, origins, directions, enter, index, rows, values, starts, steps, lights, points, first, owed)
        # Places of one slab of cells touch its voxels and the next one's first: see `sparse_grid`.
        order, slabs = slabs_of(first, block * index.shape[0] + 1)
        to_values = torch.zeros(values.shape)
        _spread(owed, points, index, rows, order, slabs, to_values.numpy())
        return None, None, None, None, None, to_values, None


def run(origins, directions, enter, leave, blocks, values, stop):
    given = (x.contiguous() for x in (origins, directions, enter, leave))
    return _BlockMarch.apply(*given, blocks, values.contiguous(), stop)
