"""Numba: each ray traverses the tree twice, to count its cells and to write them. A stack of nodes from the cube down
lets it go up no further than to the common ancestor with the next cell."""

import math

import numpy as np
import torch
from numba import njit, prange

from .._operation import empty
from . import MIN_SPEED as _MIN_SPEED

ZERO, ONE, MIN_SPEED = np.float32(0), np.float32(1), np.float32(_MIN_SPEED)
CHUNK = 64  # rays that share the memory for their nodes
FAST = {"cache": True, "error_model": "numpy"}


@njit(inline="always")
def _inverse(d, side):
    """1 / speed of a ray along an axis, in smallest cells per unit of length."""
    return ONE / ((MIN_SPEED if abs(d) < MIN_SPEED else d) * side)


@njit(inline="always")
def in_cells(o, d, r, side):
    """Origin, direction and inverse direction of ray r in units of the smallest cells."""
    dx, dy, dz = d[r, 0], d[r, 1], d[r, 2]
    ix, iy, iz = _inverse(dx, side), _inverse(dy, side), _inverse(dz, side)
    return o[r, 0] * side, o[r, 1] * side, o[r, 2] * side, dx * side, dy * side, dz * side, ix, iy, iz


@njit(inline="always")
def through_cube(ray, side, near):
    """Distances at which a ray enters the cube and leaves it."""
    ox, oy, oz, _, _, _, ix, iy, iz = ray
    a, b, c = -ox * ix, -oy * iy, -oz * iz
    d, e, f = (side - ox) * ix, (side - oy) * iy, (side - oz) * iz
    return max(min(a, d), min(b, e), min(c, f), near), min(max(a, d), max(b, e), max(c, f))


@njit(inline="always")
def cell_at(x, low, high):
    """Integer coordinate of the smallest cell at x, clamped to [low, high)."""
    return min(max(np.int64(x), low), high - 1)


@njit(inline="always")
def place_at(ray, t, side):
    """Smallest cell in the cube at a distance along a ray."""
    ox, oy, oz, dx, dy, dz, _, _, _ = ray
    return cell_at(ox + t * dx, 0, side), cell_at(oy + t * dy, 0, side), cell_at(oz + t * dz, 0, side)


@njit(inline="always")
def leaf(cells, path, level, depth, x, y, z):
    """Value and level of the leaf at a cell. path: stack of nodes down to `level`, extended to the leaf"""
    node = path[level]
    while True:
        shift = depth - level - 1
        value = np.int64(cells[node, 4 * (x >> shift & 1) + 2 * (y >> shift & 1) + (z >> shift & 1)])
        level += 1
        if value <= 0:
            return value, level
        node = value
        path[level] = node


@njit(inline="always")
def leave(x, y, z, shift, ray, t):
    """Distance at which a ray leaves the cell of side 2^shift, and the cell after it."""
    ox, oy, oz, dx, dy, dz, ix, iy, iz = ray
    size = np.int64(1) << shift
    lx, ly, lz = x >> shift << shift, y >> shift << shift, z >> shift << shift
    hx, hy, hz = lx + size, ly + size, lz + size
    tx = (np.float32(hx if ix > ZERO else lx) - ox) * ix
    ty = (np.float32(hy if iy > ZERO else ly) - oy) * iy
    tz = (np.float32(hz if iz > ZERO else lz) - oz) * iz
    end = max(min(tx, ty, tz), t)
    u, v, w = cell_at(ox + end * dx, lx, hx), cell_at(oy + end * dy, ly, hy), cell_at(oz + end * dz, lz, hz)
    if tx <= ty and tx <= tz:
        u = hx if ix > ZERO else lx - 1
    elif ty <= tz:
        v = hy if iy > ZERO else ly - 1
    else:
        w = hz if iz > ZERO else lz - 1
    return end, u, v, w


@njit(inline="always")
def cross(cells, rows, path, level, depth, x, y, z, ray, t):
    """Cross the leaf at a cell: its row, -1 for none, its level, and the results of `leave`.

    rows: `Tree.rows`; path: stack of nodes from the cube down to `level`, extended to the leaf
    """
    value, level = leaf(cells, path, level, depth, x, y, z)
    row = np.int64(-1)
    if value < 0:
        row = np.int64(rows[-1 - value]) if len(rows) else -1 - value
    end, u, v, w = leave(x, y, z, depth - level, ray, t)
    return row, level, end, u, v, w


@njit(inline="always")
def outside(u, v, w, side):
    """True outside the cube."""
    return u < 0 or v < 0 or w < 0 or u >= side or v >= side or w >= side


@njit(inline="always")
def shared(level, depth, differing):
    """Level, at most this one, of two cells' deepest common ancestor. differing: bits in which they differ"""
    while differing >> (depth - level):
        level -= 1
    return level


@njit(parallel=True, **FAST)
def _walk(o, d, cells, named, density, depth, near, most, write, starts, t_start, t_end, rows):
    """Count the cells of ray r into starts[r + 1], or write them from starts[r] on."""
    n, side = len(o), np.int64(1) << depth
    across = np.float32(side)
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        path = np.zeros(depth + 1, np.int64)
        for r in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            ray = in_cells(o, d, r, across)
            t, far = through_cube(ray, across, near)
            count, thickness, level = np.int64(0), ZERO, np.int64(0)
            if t < far:
                x, y, z = place_at(ray, t, side)
                while True:
                    row, level, end, u, v, w = cross(cells, named, path, level, depth, x, y, z, ray, t)
                    if row >= 0:
                        if write:
                            i = starts[r] + count
                            t_start[i], t_end[i], rows[i] = t, end, row
                        count += 1
                        thickness += density[row] * (end - t)
                    if outside(u, v, w, side) or thickness > most:
                        break
                    level = shared(level - 1, depth, (x ^ u) | (y ^ v) | (z ^ w))
                    x, y, z, t = u, v, w, end
            if not write:
                starts[r + 1] = count


def run(origins, directions, tree, density, near, stop):
    given = [x.detach().contiguous().numpy() for x in (origins, directions, tree.cells, tree.rows, density)]
    numbers = tree.depth, np.float32(near), np.float32(-math.log(stop) if stop > 0 else math.inf)
    starts, nothing = torch.zeros(len(origins) + 1, dtype=torch.int64), empty(0)
    rows = torch.empty(0, dtype=torch.int64)
    _walk(*given, *numbers, False, starts.numpy(), nothing.numpy(), nothing.numpy(), rows.numpy())
    starts.cumsum_(0)
    t_start, t_end = empty(int(starts[-1])), empty(int(starts[-1]))
    rows = torch.empty(int(starts[-1]), dtype=torch.int64)
    _walk(*given, *numbers, True, starts.numpy(), t_start.numpy(), t_end.numpy(), rows.numpy())
    return t_start, t_end, starts, rows
