"""Loops over single rays (Numba): octree traversal and sphere tracing through the cells of one level, in one pass.

What goes into the decoder's ReLU is trilinear in a cell (`CodeOctree.hidden`), so a step interpolates eight rows of it.
`NGLOD._traced` does the same with tensors, for GPUs, blends of levels, and as the definition that tests compare with.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from ...kernels.octree_cells.cpu import CHUNK, FAST, ONE, ZERO, cross, in_cells, outside, place_at, shared, through_cube

CORNERS = 8
HALF = np.float32(0.5)


@njit(inline="always")
def within(x, low):
    """Position of a coordinate in a cell, as a share of its side."""
    return min(max(x - np.float32(low), ZERO), ONE)


@njit(inline="always")
def blend(rows, at, h, x, y, z):
    """Trilinear interpolation of column h of eight corners' rows: its value, and its slopes by cell."""
    a, b = rows[at[0], h], rows[at[1], h]
    c, d = rows[at[2], h], rows[at[3], h]
    low_0, low_1 = a + z * (b - a), c + z * (d - c)
    low_z = b - a + y * (d - c - b + a)
    a, b = rows[at[4], h], rows[at[5], h]
    c, d = rows[at[6], h], rows[at[7], h]
    high_0, high_1 = a + z * (b - a), c + z * (d - c)
    high_z = b - a + y * (d - c - b + a)
    low, high = low_0 + y * (low_1 - low_0), high_0 + y * (high_1 - high_0)
    low_y, high_y = low_1 - low_0, high_1 - high_0
    return low + x * (high - low), high - low, low_y + x * (high_y - low_y), low_z + x * (high_z - low_z)


@njit(cache=True, fastmath=True, error_model="numpy")
def value_at(hidden, second, at, x, y, z):
    """Distance at a place in a cell: f = w_2 . relu(h), with h interpolated (eq. 4)."""
    total = ZERO
    for h in range(len(second)):
        total += second[h] * max(blend(hidden, at, h, x, y, z)[0], ZERO)
    return total


@njit(cache=True, fastmath=True, error_model="numpy")
def normal_at(hidden, second, at, x, y, z):
    """Unit gradient at a place in a cell."""
    along, across, upwards = ZERO, ZERO, ZERO
    for h in range(len(second)):
        value, a, b, c = blend(hidden, at, h, x, y, z)
        weight = second[h] if value > ZERO else ZERO
        along += weight * a
        across += weight * b
        upwards += weight * c
    scale = ONE / max(np.float32(math.sqrt(along * along + across * across + upwards * upwards)), np.float32(1e-9))
    return scale * along, scale * across, scale * upwards


@njit(inline="always")
def corner_rows(index, side, x, y, z, at):
    """Fill in the rows of a cell's corners. index: of the dense grid of corners, end to end"""
    n = side + 1
    for c in range(CORNERS):
        at[c] = index[((x + (c >> 2)) * n + y + (c >> 1 & 1)) * n + z + (c & 1)]


@njit(parallel=True, fastmath={"contract", "reassoc"}, **FAST)
def trace(o, d, cells, named, depth, near, index, hidden, second, hit_distance, max_steps, t, normals):
    """Distance along each ray to the surface, infinity without one, and the unit normal there, zero without one.

    o, d, near, t, hit_distance: in sides of the cube
    cells, named, depth: the level's `Tree`
    index, hidden: row of each corner in the dense grid, -1 for none; what goes into the ReLU there
    second: the decoder's last weights; its distances are in half sides
    """
    n, side = len(o), np.int64(1) << depth
    across = np.float32(side)
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        path, at = np.zeros(depth + 1, np.int64), np.zeros(CORNERS, np.int64)
        for r in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            t[r], steps, level = np.inf, 0, np.int64(0)
            normals[r, 0], normals[r, 1], normals[r, 2] = ZERO, ZERO, ZERO
            ray = in_cells(o, d, r, across)
            enter, far = through_cube(ray, across, near)
            if enter >= far:
                continue
            ox, oy, oz, dx, dy, dz, _, _, _ = ray
            x, y, z = place_at(ray, enter, side)
            place = before = enter
            ahead, met = ZERO, False  # 0: no value in front
            while True:
                row, level, leave, u, v, w = cross(cells, named, path, level, depth, x, y, z, ray, enter)
                if row >= 0 and place <= leave:
                    if place < enter:
                        place, ahead = enter, ZERO
                    corner_rows(index, side, x, y, z, at)
                    while place <= leave and steps < max_steps and not met:
                        a, b, c = within(ox + place * dx, x), within(oy + place * dy, y), within(oz + place * dz, z)
                        value = HALF * value_at(hidden, second, at, a, b, c)
                        steps += 1
                        if value < hit_distance:
                            met = True
                            if value < ZERO and ahead > ZERO:
                                place = before + ahead / (ahead - value) * (place - before)
                        else:
                            before, ahead = place, value
                            place += value
                if met:
                    t[r] = place
                    a, b, c = within(ox + place * dx, x), within(oy + place * dy, y), within(oz + place * dz, z)
                    normals[r, 0], normals[r, 1], normals[r, 2] = normal_at(hidden, second, at, a, b, c)
                if met or steps == max_steps or outside(u, v, w, side):
                    break
                level = shared(level - 1, depth, (x ^ u) | (y ^ v) | (z ^ w))
                x, y, z, enter = u, v, w, leave
