"""Numba: count each ray's samples, then write them. Both passes step through one function, so they cannot disagree."""

import math

import numpy as np
import torch
from numba import njit, prange

from .._dispatch import empty

ONE, HALF = np.float32(1), np.float32(0.5)


@njit(inline="always")
def _lattice(k, near, step, growth, linear, start):
    """Lattice point k: constant steps for the first `linear` of them, geometric from `start` on."""
    if k <= linear:
        return near + np.float32(k) * step
    return start * np.float32(math.exp(np.float32(k - linear) * np.float32(math.log1p(growth))))


@njit(inline="always")
def _index_of(t, near, step, growth, linear, start):
    """The lattice index, as a real number, of distance t."""
    if growth == 0 or t <= start:
        return (t - near) / step
    return np.float32(linear) + np.float32(math.log(t / start) / math.log1p(growth))


@njit
def _walk(o, d, near, far, occupied, density, step, growth, depth_limit, write, t_start, t_end, at):
    """Visit the samples of one ray; returns how many there are. Writes them at `at` on if asked to."""
    cascades, n = occupied.shape[0], occupied.shape[1]
    outermost = np.float32(2.0 ** (cascades - 1))
    linear, start = 1 << 30, np.float32(np.inf)
    if growth > 0:
        linear = max(0, math.ceil((step / growth - near) / step))
        start = near + np.float32(linear) * step
    k, count, thickness = 0, 0, np.float32(0)
    t0 = near
    while True:
        t1 = _lattice(k + 1, near, step, growth, linear, start)
        t = HALF * (t0 + t1)
        if not t < far:
            return count
        x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
        reach = max(abs(x), abs(y), abs(z))
        if reach < outermost:
            cascade, half = 0, ONE
            while reach >= half:
                half *= 2
                cascade += 1
            per_unit = np.float32(n) / (2 * half)
            cx = min(max(int((x + half) * per_unit), 0), n - 1)
            cy = min(max(int((y + half) * per_unit), 0), n - 1)
            cz = min(max(int((z + half) * per_unit), 0), n - 1)
            if occupied[cascade, cx, cy, cz]:
                if write:
                    t_start[at + count], t_end[at + count] = t0, t1
                count += 1
                thickness += density[cascade, cx, cy, cz] * (t1 - t0)
                if thickness > depth_limit:
                    return count
                k += 1
                t0 = t1
                continue
            if cascades > 1 and n % 4:  # this cell may reach into the finer cascade
                k += 1
                t0 = t1
                continue
            # Empty: on to the first midpoint that may lie outside this cell.
            leave = far
            for axis in range(3):
                c = cx if axis == 0 else cy if axis == 1 else cz
                if d[axis] > 0:
                    leave = min(leave, (np.float32(c + 1) / per_unit - half - o[axis]) / d[axis])
                elif d[axis] < 0:
                    leave = min(leave, (np.float32(c) / per_unit - half - o[axis]) / d[axis])
            k = max(k + 1, math.ceil(_index_of(leave, near, step, growth, linear, start) - np.float32(0.51)))
        else:
            if x * d[0] + y * d[1] + z * d[2] > 0 and reach > 4 * outermost:
                return count  # going away for good
            k += 1
        t0 = _lattice(k, near, step, growth, linear, start)


@njit(parallel=True, cache=True)
def _count(o, d, near, far, occupied, density, step, growth, depth_limit, counts):
    nothing = np.empty(0, np.float32)
    for r in prange(len(o)):
        counts[r] = _walk(
            o[r], d[r], near[r], far[r], occupied, density, step, growth, depth_limit, False, nothing, nothing, 0
        )


@njit(parallel=True, cache=True)
def _write(o, d, near, far, occupied, density, step, growth, depth_limit, starts, t_start, t_end):
    for r in prange(len(o)):
        _walk(
            o[r], d[r], near[r], far[r], occupied, density, step, growth, depth_limit, True, t_start, t_end, starts[r]
        )


def run(origins, directions, t_near, t_far, occupied, density, step, growth, stop):
    tensors = (origins, directions, t_near, t_far, occupied, density)
    arrays = [x.detach().contiguous().numpy() for x in tensors]
    depth_limit = -math.log(stop) if stop > 0 else math.inf
    scalars = [np.float32(step), np.float32(growth), np.float32(depth_limit)]
    starts = torch.zeros(len(origins) + 1, dtype=torch.int64)
    _count(*arrays, *scalars, starts[1:].numpy())
    torch.cumsum(starts, 0, out=starts)
    t_start, t_end = empty(int(starts[-1])), empty(int(starts[-1]))
    _write(*arrays, *scalars, starts.numpy(), t_start.numpy(), t_end.numpy())
    return t_start, t_end, starts
