"""Numba: a task takes some rays. A ray skips a missing block in one step."""

import math

import numpy as np
from numba import njit, prange

from .._operation import empty
from ..block_hash import SIDE
from ..block_hash.cpu import find
from .reference import GREY as MIDDLE

ZERO, ONE, INFINITE, UNKNOWN = np.float32(0), np.float32(1), np.float32(np.inf), np.float32(np.nan)
GREY, FLAT = np.float32(MIDDLE), np.float32(1e-6)
EARLY = np.float32(0.02)  # steps by which a stride ends before its block does: rounding must skip none
RAYS_PER_TASK = 64


@njit(inline="always", error_model="numpy")
def _gather(x, y, z, number, voxels, blocks, table, d, w, rows):
    """Load distance, weight and row of the eight voxels from (x, y, z) on, whose block is `number`."""
    i, j, k = x & 7, y & 7, z & 7
    inside = i < SIDE - 1 and j < SIDE - 1 and k < SIDE - 1
    for c in range(8):
        a, b, e = i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)
        held = number
        if not inside and (a == SIDE or b == SIDE or e == SIDE):
            held = find((x >> 3) + (a >> 3), (y >> 3) + (b >> 3), (z >> 3) + (e >> 3), blocks, table)
        row = (((a & 7) << 6) | ((b & 7) << 3)) | (e & 7)
        rows[c] = -1
        w[c] = ZERO
        if held >= 0:
            rows[c] = held * 512 + row
            d[c] = voxels[held, row, 0]
            w[c] = voxels[held, row, 1]


@njit(inline="always", error_model="numpy")
def _all_known(w):
    return (
        w[0] > ZERO and w[1] > ZERO and w[2] > ZERO and w[3] > ZERO
        and w[4] > ZERO and w[5] > ZERO and w[6] > ZERO and w[7] > ZERO
    )  # fmt: skip


@njit(error_model="numpy")
def _exit(base, p, d, over):
    """Distance in voxels along a ray to its exit from the block of a voxel, along one axis."""
    if d > ZERO:
        return (np.float32((base >> 3) * SIDE + SIDE) - p) * over
    if d < ZERO:
        return (np.float32((base >> 3) * SIDE) - p) * over
    return INFINITE


@njit(error_model="numpy")
def _cast_one(ox, oy, oz, dx, dy, dz, near, far, voxels, blocks, table, per_unit, step, d, w, rows):
    """Distance to the surface, infinite without one. d, w, rows: buffers for eight voxels"""
    ix, iy, iz = ONE / dx, ONE / dy, ONE / dz
    before, k = UNKNOWN, np.int64(0)
    last_x, last_y, last_z, number = np.int64(1) << 40, np.int64(0), np.int64(0), np.int64(-1)
    while True:
        t = near + np.float32(k) * step
        if not t < far:
            return INFINITE
        px, py, pz = (ox + t * dx) * per_unit, (oy + t * dy) * per_unit, (oz + t * dz) * per_unit
        x, y, z = np.int64(math.floor(px)), np.int64(math.floor(py)), np.int64(math.floor(pz))
        if x >> 3 != last_x or y >> 3 != last_y or z >> 3 != last_z:
            last_x, last_y, last_z = x >> 3, y >> 3, z >> 3
            number = find(last_x, last_y, last_z, blocks, table)
        if number < 0:
            leave = min(_exit(x, px, dx, ix), min(_exit(y, py, dy, iy), _exit(z, pz, dz, iz))) / per_unit
            stride = leave / step - EARLY
            if not stride < np.float32(1e9):
                return INFINITE
            k += max(np.int64(1), np.int64(math.ceil(stride)))
            before = UNKNOWN
            continue
        _gather(x, y, z, number, voxels, blocks, table, d, w, rows)
        if _all_known(w):
            u, v, s = px - np.float32(x), py - np.float32(y), pz - np.float32(z)
            c00, c01 = d[0] + s * (d[1] - d[0]), d[2] + s * (d[3] - d[2])
            c10, c11 = d[4] + s * (d[5] - d[4]), d[6] + s * (d[7] - d[6])
            c0, c1 = c00 + v * (c01 - c00), c10 + v * (c11 - c10)
            distance = c0 + u * (c1 - c0)
            if distance < ZERO and before >= ZERO:
                return t - step + step * before / (before - distance)
            before = distance
        else:
            before = UNKNOWN
        k += 1


@njit(parallel=True, cache=True, error_model="numpy")
def _cast(o, r, near, far, voxels, blocks, table, per_unit, step, out, normal, rgb):
    for task in prange((len(o) + RAYS_PER_TASK - 1) // RAYS_PER_TASK):
        d, w, rows = np.zeros(8, np.float32), np.zeros(8, np.float32), np.zeros(8, np.int64)
        for i in range(task * RAYS_PER_TASK, min((task + 1) * RAYS_PER_TASK, len(o))):
            dx, dy, dz = r[i, 0], r[i, 1], r[i, 2]
            t = _cast_one(
                o[i, 0], o[i, 1], o[i, 2], dx, dy, dz, near[i], far[i],
                voxels, blocks, table, per_unit, step, d, w, rows,
            )  # fmt: skip
            out[i] = t
            normal[i, 0], normal[i, 1], normal[i, 2] = -dx, -dy, -dz
            rgb[i, 0], rgb[i, 1], rgb[i, 2] = GREY, GREY, GREY
            if not t < INFINITE:
                continue
            px, py, pz = (o[i, 0] + t * dx) * per_unit, (o[i, 1] + t * dy) * per_unit, (o[i, 2] + t * dz) * per_unit
            x, y, z = np.int64(math.floor(px)), np.int64(math.floor(py)), np.int64(math.floor(pz))
            number = find(x >> 3, y >> 3, z >> 3, blocks, table)
            _gather(x, y, z, number, voxels, blocks, table, d, w, rows)
            u, v, s = px - np.float32(x), py - np.float32(y), pz - np.float32(z)
            gx, gy, gz, total, red, green, blue = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
            for c in range(8):
                a, b, e = c >> 2, (c >> 1) & 1, c & 1
                su, sv, ss = u if a else ONE - u, v if b else ONE - v, s if e else ONE - s
                if w[c] > ZERO:
                    gx += (d[c] if a else -d[c]) * sv * ss
                    gy += (d[c] if b else -d[c]) * su * ss
                    gz += (d[c] if e else -d[c]) * su * sv
                    held, row = rows[c] >> 9, rows[c] & 511
                    if voxels[held, row, 2] >= ZERO:
                        share = su * sv * ss
                        total += share
                        red += share * voxels[held, row, 2]
                        green += share * voxels[held, row, 3]
                        blue += share * voxels[held, row, 4]
            length = np.sqrt(gx * gx + gy * gy + gz * gz)
            if _all_known(w) and length > FLAT:
                normal[i, 0], normal[i, 1], normal[i, 2] = gx / length, gy / length, gz / length
            if total > FLAT:
                rgb[i, 0], rgb[i, 1], rgb[i, 2] = red / total, green / total, blue / total


def run(origins, directions, t_near, t_far, voxels, blocks, table, voxel, step):
    given = origins, directions, t_near, t_far, voxels, blocks, table
    out, normal, rgb = empty(len(origins)), empty(len(origins), 3), empty(len(origins), 3)
    arrays = (x.detach().contiguous().numpy() for x in given)
    _cast(*arrays, np.float32(1 / voxel), np.float32(step), out.numpy(), normal.numpy(), rgb.numpy())
    return out, normal, rgb
