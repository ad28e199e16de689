"""Numba: each ray walks its lattice once and stores the indices of kept intervals; a second pass computes distances."""

import math

import numpy as np
import torch
from numba import njit, prange
from torch.utils.weak import WeakTensorKeyDictionary

from .._operation import empty

ZERO, HALF, ONE, TWO = (np.float32(x) for x in (0, 0.5, 1, 2))
BLOCK_BITS = 2  # log2 of the cells per axis of the blocks that empty space is skipped by
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
def _exit(cell, clear, per_unit, half, origin, direction, inverse):
    """Distance at which a ray leaves a cell and the empty space around it, along one axis."""
    if direction == ZERO:
        return np.float32(np.inf)
    side = np.float32(cell + clear) if direction > ZERO else np.float32(cell + 1 - clear)
    return (side / per_unit - half - origin) * inverse


@njit(**FAST)
def _walk(ox, oy, oz, dx, dy, dz, near, far, occupied, clearance, density, step, growth, depth_limit, kept, first):
    """Store the indices of one ray's kept intervals from kept[first] on; returns their number.

    Takes numbers rather than rows: rows are reference-counted, which makes threads wait for each other.
    """
    cascades, n = occupied.shape[:2]
    shift, block = (0, ONE) if clearance.shape[1] == n else (BLOCK_BITS, np.float32(1 << BLOCK_BITS))
    outermost = np.float32(1 << (cascades - 1))
    linear, bend = _bend(near, step, growth)
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
            bx, by, bz = cx >> shift, cy >> shift, cz >> shift
            clear = np.int64(clearance[cascade, bx, by, bz])
            if clear:
                cx, cy, cz, per_unit = bx, by, bz, per_unit / block
            elif occupied[cascade, cx, cy, cz]:
                kept[first + count] = k
                count += 1
                if depth_limit < np.float32(np.inf):
                    thickness += density[cascade, cx, cy, cz] * (t1 - t0)
                    if thickness > depth_limit:
                        return count
                k += 1
                t0 = t1
                continue
            # A step where a leap would hardly be longer, or where this cell may reach into the finer cascade.
            if (clear == 0 and (t1 - t0) * per_unit > HALF) or (cascades > 1 and n % 4):
                k += 1
                t0 = t1
                continue
            # Empty: on to the first midpoint that may lie outside this cell, or outside all the clear blocks around it.
            clear = max(clear, np.int64(1))
            leave = min(
                _exit(cx, clear, per_unit, half, ox, dx, ix),
                _exit(cy, clear, per_unit, half, oy, dy, iy),
                _exit(cz, clear, per_unit, half, oz, dz, iz),
                far,
            )
            beyond = _index_of(leave, near, step, growth, linear, bend) - np.float32(0.51)
            k = max(k + 1, np.int64(np.ceil(beyond)))
        t0 = _lattice(k, near, step, growth, linear, bend)


@njit(parallel=True, **FAST)
def _room(o, near, far, outermost, step, growth, end, room):
    """End of each ray, at the latest where it has left every cascade, and an upper bound of its samples."""
    for r in prange(len(near)):
        away = np.sqrt(o[r, 0] * o[r, 0] + o[r, 1] * o[r, 1] + o[r, 2] * o[r, 2])
        end[r] = min(far[r], away + TWO * outermost)
        linear, bend = _bend(near[r], step, growth)
        last = _index_of(end[r], near[r], step, growth, linear, bend) if end[r] > near[r] else ZERO
        room[r] = np.int64(last) + 2


@njit(parallel=True, **FAST)
def _walk_all(o, d, near, far, occupied, clearance, density, step, growth, depth_limit, begin, kept, counts):
    for r in prange(len(o)):
        counts[r] = _walk(
            o[r, 0], o[r, 1], o[r, 2], d[r, 0], d[r, 1], d[r, 2], near[r], far[r],
            occupied, clearance, density, step, growth, depth_limit, kept, begin[r],
        )  # fmt: skip


@njit(parallel=True, **FAST)
def _write(near, step, growth, begin, kept, starts, t_start, t_end):
    for r in prange(len(near)):
        linear, bend = _bend(near[r], step, growth)
        for i in range(starts[r + 1] - starts[r]):
            k = np.int64(kept[begin[r] + i])
            t_start[starts[r] + i] = _lattice(k, near[r], step, growth, linear, bend)
            t_end[starts[r] + i] = _lattice(k + 1, near[r], step, growth, linear, bend)


@njit(cache=True)
def _measure(clear):
    """Distance transform: replace 0 (occupied block) and 1 (empty) by the distance to the nearest occupied block or
                        border.

    Chebyshev distance in two sweeps (Rosenfeld and Pfaltz 1968). At k, the (2k - 1)^3 blocks around are empty.
    """
    cascades, n = clear.shape[:2]
    for cascade in range(cascades):
        for sweep in (1, -1):
            for i in range(n * n * n):
                j = i if sweep > 0 else n * n * n - 1 - i
                x, y, z = j // (n * n), j // n % n, j % n
                if not clear[cascade, x, y, z]:
                    continue
                nearest = min(x, y, z, n - 1 - x, n - 1 - y, n - 1 - z, 254)
                if nearest:
                    if sweep < 0:
                        nearest = min(nearest, clear[cascade, x, y, z] - 1)
                    for before in range(13):  # the neighbours that this sweep has passed
                        a, b, c = before // 9 - 1, before // 3 % 3 - 1, before % 3 - 1
                        a, b, c = sweep * a, sweep * b, sweep * c
                        nearest = min(nearest, np.int64(clear[cascade, x + a, y + b, z + c]))
                clear[cascade, x, y, z] = nearest + 1


_known: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


def _clearance(occupied):
    """Clearance (cascade, x, y, z) of each block of cells: distance in blocks to the nearest occupied one; 0 in
    occupied blocks. Rays skip that far. Computed once for each state of a grid."""
    version, clear = _known.get(occupied, (None, None))
    if version != occupied._version:
        cascades, n = occupied.shape[:2]
        m = n >> BLOCK_BITS if n % (4 << BLOCK_BITS) == 0 else n
        holds = occupied.view(cascades, m, n // m, m, n // m, m, n // m).any(6).any(4).any(2)
        inner = slice(m // 4, m - m // 4)
        holds[1:, inner, inner, inner] = True  # there a finer cascade knows better
        clear = (~holds).to(torch.uint8).numpy()
        _measure(clear)
        _known[occupied] = occupied._version, clear
    return clear


def run(origins, directions, t_near, t_far, occupied, density, step, growth, stop):
    tensors = (origins, directions, t_near, t_far, occupied, density)
    o, d, near, far, occupied, density = (x.detach().contiguous().numpy() for x in tensors)
    clearance = _clearance(tensors[4])
    step, growth = np.float32(step), np.float32(growth)
    depth_limit = np.float32(-math.log(stop) if stop > 0 else math.inf)
    begin, starts = (np.zeros(len(o) + 1, np.int64) for _ in range(2))
    end = np.empty_like(far)
    _room(o, near, far, np.float32(2.0 ** (len(occupied) - 1)), step, growth, end, begin[1:])
    np.cumsum(begin, out=begin)
    kept = np.empty(begin[-1], np.int32)  # mostly untouched
    _walk_all(o, d, near, end, occupied, clearance, density, step, growth, depth_limit, begin, kept, starts[1:])
    np.cumsum(starts, out=starts)
    t_start, t_end = empty(int(starts[-1])), empty(int(starts[-1]))
    _write(near, step, growth, begin, kept, starts, t_start.numpy(), t_end.numpy())
    return t_start, t_end, torch.from_numpy(starts)
