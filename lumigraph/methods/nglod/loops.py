"""Loops over single rays (Numba): sphere tracing through the cells of one level of an octree of codes.

`NGLOD._traced` does the same with tensors, for GPUs, blends of levels, and as the definition that tests compare with.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

CORNERS = 8
PART = 256  # rays that share a thread's buffers


@njit(cache=True, fastmath=True, error_model="numpy")
def weigh(x, y, z, n, index, at, weight):
    """Rows of the corners around a point in one level, and their trilinear weights."""
    fx, fy, fz = (0.5 * x + 0.5) * n, (0.5 * y + 0.5) * n, (0.5 * z + 0.5) * n
    i, j, k = min(max(int(fx), 0), n - 1), min(max(int(fy), 0), n - 1), min(max(int(fz), 0), n - 1)
    fx, fy, fz = fx - i, fy - j, fz - k
    for c in range(CORNERS):
        a, b, d = c >> 2, c >> 1 & 1, c & 1
        at[c] = index[((i + a) * (n + 1) + j + b) * (n + 1) + k + d]
        weight[c] = (fx if a else 1 - fx) * (fy if b else 1 - fy) * (fz if d else 1 - fz)
    return fx, fy, fz


@njit(cache=True, fastmath=True, error_model="numpy")
def value_at(x, y, z, last, base, indices, starts, offsets, features, first, second, at, weight, inputs, hidden):
    """Distance at a point in a cell of the last level: summed features, then the decoder's hidden layer and output."""
    width = features.shape[1]
    inputs[:width] = 0.0
    for level in range(last + 1):
        n = base << level
        weigh(x, y, z, n, indices[starts[level] : starts[level + 1]], at, weight)
        for c in range(CORNERS):
            if at[c] >= 0:
                row, w = offsets[level] + at[c], weight[c]
                for f in range(width):
                    inputs[f] += w * features[row, f]
    inputs[width], inputs[width + 1], inputs[width + 2] = x, y, z
    hidden[:] = 0.0
    for i in range(width + 3):
        w = inputs[i]
        for h in range(len(hidden)):
            hidden[h] += w * first[i, h]
    total = np.float32(0.0)
    for h in range(len(hidden)):
        total += second[h] * max(hidden[h], np.float32(0.0))
    return total


@njit(cache=True, fastmath=True, error_model="numpy")
def slope_at(x, y, z, last, base, indices, starts, offsets, features, first, second, at, weight, hidden, to_input, out):
    """Gradient at the point that `value_at` was last called for."""
    width = features.shape[1]
    for i in range(width + 3):
        total = np.float32(0.0)
        for h in range(len(hidden)):
            total += first[i, h] * (second[h] if hidden[h] > 0 else np.float32(0.0))
        to_input[i] = total
    for axis in range(3):
        out[axis] = to_input[width + axis]
    for level in range(last + 1):
        n = base << level
        fx, fy, fz = weigh(x, y, z, n, indices[starts[level] : starts[level + 1]], at, weight)
        scale = np.float32(0.5 * n)
        for c in range(CORNERS):
            if at[c] < 0:
                continue
            row, along = offsets[level] + at[c], np.float32(0.0)
            for f in range(width):
                along += to_input[f] * features[row, f]
            a, b, d = c >> 2, c >> 1 & 1, c & 1
            wx, wy, wz = (fx if a else 1 - fx), (fy if b else 1 - fy), (fz if d else 1 - fz)
            out[0] += scale * along * (1 if a else -1) * wy * wz
            out[1] += scale * along * (1 if b else -1) * wx * wz
            out[2] += scale * along * (1 if d else -1) * wx * wy


@njit(parallel=True, cache=True, fastmath={"contract", "reassoc"}, error_model="numpy")
def trace(
    origins, directions, t_start, t_end, ray_starts, last, base, indices, starts, offsets, features, first, second,
    hit_distance, max_steps, t, normals,
):  # fmt: skip
    """Distance along each ray to the surface, infinity without one, and the unit normal there.

    t_start, t_end, ray_starts: intervals of rays in cells of the last level, scene units
    base:             cells per axis of the first level
    indices, starts:  row of each corner of each level's dense grid, end to end; -1 for none
    features, offsets: of the corners of all levels, end to end
    first, second:    the decoder's weights, (inputs, hidden) and (hidden,)
    """
    for part in prange((len(origins) + PART - 1) // PART):
        at, weight = np.empty(CORNERS, np.int64), np.empty(CORNERS, np.float32)
        inputs, hidden = np.empty(len(first), np.float32), np.empty(len(second), np.float32)
        to_input, slope = np.empty(len(first), np.float32), np.empty(3, np.float32)
        for ray in range(part * PART, min(part * PART + PART, len(origins))):
            t[ray] = np.inf
            span, end = ray_starts[ray], ray_starts[ray + 1]
            if span == end:
                continue
            place = t_start[span]
            before, ahead = place, np.float32(0.0)
            for _ in range(max_steps):
                x = origins[ray, 0] + place * directions[ray, 0]
                y = origins[ray, 1] + place * directions[ray, 1]
                z = origins[ray, 2] + place * directions[ray, 2]
                value = value_at(
                    x, y, z, last, base, indices, starts, offsets, features, first, second, at, weight, inputs, hidden
                )
                if value < hit_distance:
                    if value < 0 and ahead > 0:
                        place = before + ahead / max(ahead - value, np.float32(1e-9)) * (place - before)
                        x = origins[ray, 0] + place * directions[ray, 0]
                        y = origins[ray, 1] + place * directions[ray, 1]
                        z = origins[ray, 2] + place * directions[ray, 2]
                        value_at(
                            x, y, z, last, base, indices, starts, offsets, features, first, second, at, weight, inputs,
                            hidden,
                        )  # fmt: skip
                    t[ray] = place
                    slope_at(
                        x, y, z, last, base, indices, starts, offsets, features, first, second, at, weight, hidden,
                        to_input, slope,
                    )  # fmt: skip
                    size = math.sqrt(slope[0] * slope[0] + slope[1] * slope[1] + slope[2] * slope[2])
                    for axis in range(3):
                        normals[ray, axis] = slope[axis] / max(size, 1e-9)
                    break
                before, ahead = place, value
                place = place + max(value, hit_distance)
                while span < end and t_end[span] < place:
                    span += 1
                if span == end:
                    break
                if t_start[span] > place:
                    place, ahead = t_start[span], np.float32(0.0)
