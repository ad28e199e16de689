"""Numba: each ray walks its lattice once and notes the indices it keeps; a second pass writes them out as distances."""

import math

import numpy as np
import torch
from numba import njit, prange
from torch.utils.weak import WeakTensorKeyDictionary

from .._dispatch import empty

ZERO, HALF, ONE, TWO = (np.float32(x) for x in (0, 0.5, 1, 2))
BLOCK = 4  # cells per axis of the blocks that empty space is skipped by
FAST = {"cache": True, "error_model": "numpy"}


@njit(inline="always")
def _bend(near, step, growth):
    """Index and distance at which constant steps turn geometric."""
    if growth == 0:
        return np.int64(1 << 30), np.float32(np.inf)
    linear = np.int64(max(ZERO, np.ceil((step / growth - near) / step)))
    return linear, near + np.float32(linear) * step


@njit(inline="always")
def _lattice(k, near, step, growth, linear, bend):
    """Lattice point k."""
    if k <= linear:
        return near + np.float32(k) * step
    return bend * np.exp(np.float32(k - linear) * np.log1p(growth))


@njit(inline="always")
def _index_of(t, near, step, growth, linear, bend):
    """The lattice index, as a real number, of distance t."""
    if t <= bend:
        return (t - near) / step
    return np.float32(linear) + np.log(t / bend) / np.log1p(growth)


@njit(inline="always")
def _exit(cell, per_unit, half, origin, direction, inverse):
    """Distance at which a ray leaves a cell through the side it heads for along one axis."""
    if direction == ZERO:
        return np.float32(np.inf)
    side = np.float32(cell + 1) if direction > ZERO else np.float32(cell)
    return (side / per_unit - half - origin) * inverse


@njit(**FAST)
def _walk(o, d, near, far, occupied, blocks, density, step, growth, depth_limit, kept):
    """Note the lattice intervals of one ray that are kept; returns how many."""
    cascades, n, block = occupied.shape[0], occupied.shape[1], occupied.shape[1] // blocks.shape[1]
    outermost = np.float32(1 << (cascades - 1))
    linear, bend = _bend(near, step, growth)
    ox, oy, oz, dx, dy, dz = o[0], o[1], o[2], d[0], d[1], d[2]
    ix, iy, iz = ONE / dx, ONE / dy, ONE / dz
    k, count, thickness, t0 = np.int64(0), 0, ZERO, near
    while True:
        t1 = _lattice(k + 1, near, step, growth, linear, bend)
        t = HALF * (t0 + t1)
        if not t < far:
            return count
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        reach = max(abs(x), abs(y), abs(z))
        if reach >= outermost:
            if reach > np.float32(4) * outermost and x * dx + y * dy + z * dz > ZERO:
                return count  # going away for good
            k += 1
        else:
            cascade, half = 0, ONE
            while reach >= half:
                half = half + half
                cascade += 1
            per_unit = np.float32(n) / (half + half)
            cx, cy, cz = (
                min(max(np.int64((x + half) * per_unit), 0), n - 1),
                min(max(np.int64((y + half) * per_unit), 0), n - 1),
                min(max(np.int64((z + half) * per_unit), 0), n - 1),
            )
            bx, by, bz = cx // block, cy // block, cz // block
            if not blocks[cascade, bx, by, bz]:
                cx, cy, cz, per_unit = bx, by, bz, per_unit / np.float32(block)
            elif occupied[cascade, cx, cy, cz]:
                kept[count] = k
                count += 1
                thickness += density[cascade, cx, cy, cz] * (t1 - t0)
                if thickness > depth_limit:
                    return count
                k += 1
                t0 = t1
                continue
            if cascades > 1 and n % 4:  # this cell may reach into the finer cascade: a step, no leap
                k += 1
                t0 = t1
                continue
            # Empty: on to the first midpoint that may lie outside this cell, or block of cells.
            leave = min(
                _exit(cx, per_unit, half, ox, dx, ix),
                _exit(cy, per_unit, half, oy, dy, iy),
                _exit(cz, per_unit, half, oz, dz, iz),
                far,
            )
            beyond = _index_of(leave, near, step, growth, linear, bend) - np.float32(0.51)
            k = max(k + 1, np.int64(np.ceil(beyond)))
        t0 = _lattice(k, near, step, growth, linear, bend)


@njit(parallel=True, **FAST)
def _room(near, far, step, growth, room):
    """At most how many samples each ray can have."""
    for r in prange(len(near)):
        linear, bend = _bend(near[r], step, growth)
        last = _index_of(far[r], near[r], step, growth, linear, bend) if far[r] > near[r] else ZERO
        room[r] = np.int64(last) + 2


@njit(parallel=True, **FAST)
def _walk_all(o, d, near, far, occupied, blocks, density, step, growth, depth_limit, begin, kept, counts):
    for r in prange(len(o)):
        room = kept[begin[r] : begin[r + 1]]
        counts[r] = _walk(o[r], d[r], near[r], far[r], occupied, blocks, density, step, growth, depth_limit, room)


@njit(parallel=True, **FAST)
def _write(near, step, growth, begin, kept, starts, t_start, t_end):
    for r in prange(len(near)):
        linear, bend = _bend(near[r], step, growth)
        for i in range(starts[r + 1] - starts[r]):
            k = np.int64(kept[begin[r] + i])
            t_start[starts[r] + i] = _lattice(k, near[r], step, growth, linear, bend)
            t_end[starts[r] + i] = _lattice(k + 1, near[r], step, growth, linear, bend)


_known: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


def _blocks(occupied):
    """Which blocks of cells hold an occupied one; worked out once for each state of a grid."""
    version, blocks = _known.get(occupied, (None, None))
    if version != occupied._version:
        cascades, n = occupied.shape[:2]
        m = n // BLOCK if n % (4 * BLOCK) == 0 else n
        blocks = occupied.view(cascades, m, n // m, m, n // m, m, n // m).any(6).any(4).any(2).numpy()
        _known[occupied] = occupied._version, blocks
    return blocks


def run(origins, directions, t_near, t_far, occupied, density, step, growth, stop):
    t_far = torch.minimum(t_far, origins.norm(dim=-1) + 2.0 * 2.0 ** (len(occupied) - 1))  # beyond every cascade
    tensors = (origins, directions, t_near, t_far, occupied, density)
    o, d, near, far, occupied, density = (x.detach().contiguous().numpy() for x in tensors)
    blocks = _blocks(tensors[4])
    step, growth = np.float32(step), np.float32(growth)
    depth_limit = np.float32(-math.log(stop) if stop > 0 else math.inf)
    begin, starts = (np.zeros(len(o) + 1, np.int64) for _ in range(2))
    _room(near, far, step, growth, begin[1:])
    np.cumsum(begin, out=begin)
    kept = np.empty(begin[-1], np.int32)  # mostly untouched
    _walk_all(o, d, near, far, occupied, blocks, density, step, growth, depth_limit, begin, kept, starts[1:])
    np.cumsum(starts, out=starts)
    t_start, t_end = empty(int(starts[-1])), empty(int(starts[-1]))
    _write(near, step, growth, begin, kept, starts, t_start.numpy(), t_end.numpy())
    return t_start, t_end, torch.from_numpy(starts)
