"""Numba. Threads share the rays. Backward, each ray's steps are repeated and stored, its gradients computed back to
front, and each step's gradient is added to rows slab by slab, so that no two threads add to one row."""

import numpy as np
import torch
from numba import njit, prange

from .._operation import differentiable, empty
from ..sparse_grid.cpu import slabs_of
from .reference import MIN_STRIDE_DIVISOR

ZERO, HALF, ONE, TWO, FOUR = (np.float32(x) for x in (0, 0.5, 1, 2, 4))
MIN_DIVISOR = np.float32(MIN_STRIDE_DIVISOR)
FAR = np.float32(1e30)
CHUNK = 64  # rays a thread takes at a time
C, A = 8, 3  # channels, and which of them is alpha
SURE_STEP = np.float32(0.9)  # voxels of a step, in a count of steps that must not lead too far


@njit(inline="always")
def placed(o, d, t, ball):
    """Grid position of a ray at a distance; contracted, if there is a ball (Barron 2022, eq. 10)."""
    x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
    if ball > ZERO:
        middle = TWO * ball - HALF
        u, v, w = x - middle, y - middle, z - middle
        radius = np.sqrt(u * u + v * v + w * w)
        if radius > ball:
            share = ball / radius
            scale = (TWO - share) * share
            x, y, z = middle + scale * u, middle + scale * v, middle + scale * w
    return x, y, z


@njit(inline="always")
def nearest(o, d, ball):
    """Distance from a ray's point closest to the ball's centre to its origin, and that point's squared radius."""
    middle = TWO * ball - HALF
    u, v, w = o[0] - middle, o[1] - middle, o[2] - middle
    along = u * d[0] + v * d[1] + w * d[2]
    u, v, w = u - along * d[0], v - along * d[1], w - along * d[2]
    return along, u * u + v * v + w * w


@njit(inline="always")
def later(t, steps, along, aside, ball):
    """Distance after so many more steps. along, aside: of `nearest`"""
    if ball == ZERO:
        return t + np.float32(steps)
    for _ in range(steps):
        radius = np.sqrt(aside + (along + t) * (along + t))
        if radius <= ball:
            t += ONE
        else:
            share = ball / radius
            speed = np.sqrt(ONE + FOUR * aside / (ball * ball) * (ONE - share)) * share * ball
            t += radius / max(speed - (along + t) / radius, MIN_DIVISOR)
    return t


@njit(inline="always")
def block_of(x, y, z, index, block):
    """Coordinates and number of the block at a position; number -1 outside the grid and for no block."""
    wide = np.float32(block)
    bx, by, bz = np.floor((x + HALF) / wide), np.floor((y + HALF) / wide), np.floor((z + HALF) / wide)
    ix, iy, iz = np.int64(bx), np.int64(by), np.int64(bz)
    inside = ix >= 0 and iy >= 0 and iz >= 0 and ix < index.shape[0] and iy < index.shape[1] and iz < index.shape[2]
    number = np.int64(index[ix, iy, iz]) if inside else np.int64(-1)
    return ix, iy, iz, number


@njit(inline="always")
def to_side(x, d, b, block):
    """Distance along a ray to its exit from block b of one axis."""
    if abs(d) < np.float32(1e-9):
        return FAR
    return (np.float32(block * (b + (d > 0))) - HALF - x) / d


@njit(inline="always")
def beyond(x, y, z, dx, dy, dz, bx, by, bz, block):
    """Number of steps, at least one, to leave a block."""
    away = min(to_side(x, dx, bx, block), to_side(y, dy, by, block), to_side(z, dz, bz, block))
    return max(np.int64(1), np.int64(np.ceil(min(away, np.float32(1e9)))))


@njit(inline="always")
def from_sides(x, b, block):
    """Distance along one axis to the nearer side of block b."""
    inside = x + HALF - np.float32(block * b)
    return min(inside, np.float32(block) - inside)


@njit(inline="always")
def past(x, y, z, d, bx, by, bz, number, block, ball):
    """Number of steps, at least one, over the empty space around a block; conservative, since rays may curve."""
    if ball == ZERO:
        return beyond(x, y, z, d[0], d[1], d[2], bx, by, bz, block)
    clear = min(from_sides(x, bx, block), from_sides(y, by, block), from_sides(z, bz, block))
    clear += np.float32(block * (-1 - number))
    return max(np.int64(1), np.int64(SURE_STEP * clear))


@njit(inline="always")
def cell_of(x, b, block):
    """Along one axis: the voxel below a position, counted within its block, and the fractional position above it."""
    place = x - np.float32(block * b) + ONE
    cell = min(max(np.int64(place), np.int64(0)), np.int64(block))
    return cell, place - np.float32(cell)


@njit(inline="always")
def onward(row, ball):
    """Number of steps that an empty voxel's distance lets a ray skip; 0 where a voxel has a row. One less on curved
    rays, whose steps may be longer than a voxel."""
    leap = np.int64(0) if row >= -1 else np.int64(-1 - row)
    return leap if ball == ZERO else max(leap - 1, np.int64(0))


@njit(inline="always")
def corners(rows, number, cx, fx, cy, fy, cz, fz, at, weights):
    """Rows and trilinear weights of the non-empty ones of the eight voxels; returns their number."""
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
def blended(values, at, weights, count, v):
    for c in range(C):
        v[c] = ZERO
    for k in range(count):
        row, weight = at[k], weights[k]
        for c in range(C):
            v[c] += weight * values[row, c]


@njit(inline="always")
def next_met(o, d, t, end, ahead, aside, index, rows, ball, at, weights):
    """Next step from t on at non-empty voxels, and their number; 0 for none before the end.

    ahead, aside: of `nearest`; at, weights: filled by `corners`
    """
    block, count = rows.shape[1] - 2, 0
    while t < end:
        x, y, z = placed(o, d, t, ball)
        bx, by, bz, number = block_of(x, y, z, index, block)
        if number < 0:
            t = later(t, past(x, y, z, d, bx, by, bz, number, block, ball), ahead, aside, ball)
            continue
        (cx, fx), (cy, fy), (cz, fz) = cell_of(x, bx, block), cell_of(y, by, block), cell_of(z, bz, block)
        leap = onward(rows[number, cx, cy, cz], ball)
        if leap == 0:
            count = corners(rows, number, cx, fx, cy, fy, cz, fz, at, weights)
            if count > 0:
                break
            leap = np.int64(1)
        t = later(t, leap, ahead, aside, ball)
    return t, count


@njit(parallel=True, fastmath=True, cache=True)
def _forward(origins, directions, enter, leave, index, rows, values, ball, stop, totals, distance, lengths):
    """lengths: number of non-empty steps of each ray"""
    n = len(origins)
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        at, weights = np.empty(9, np.int64), np.empty(9, np.float32)
        v, total = np.empty(C, np.float32), np.empty(C, np.float32)
        for r in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            o, d, t = origins[r], directions[r], enter[r]
            ahead, aside = nearest(o, d, ball)
            transmittance, along, met = ONE, ZERO, 0
            for c in range(C):
                total[c] = ZERO
            while transmittance >= stop:
                t, count = next_met(o, d, t, leave[r], ahead, aside, index, rows, ball, at, weights)
                if count == 0:
                    break
                met += 1
                blended(values, at, weights, count, v)
                for c in range(C):
                    total[c] += transmittance * v[c]
                along += transmittance * v[A] * t
                transmittance *= ONE - v[A]
                t = later(t, 1, ahead, aside, ball)
            for c in range(C):
                totals[r, c] = total[c]
            distance[r], lengths[r] = along, met


@njit(parallel=True, fastmath=True, cache=True)
def _steps(origins, directions, enter, leave, index, rows, values, ball, starts, steps, transmittances):
    """Distances and transmittances of each ray's non-empty steps."""
    n = len(origins)
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        at, weights, v = np.empty(9, np.int64), np.empty(9, np.float32), np.empty(C, np.float32)
        for r in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            o, d, t, transmittance = origins[r], directions[r], enter[r], ONE
            ahead, aside = nearest(o, d, ball)
            for s in range(starts[r], starts[r + 1]):
                t, count = next_met(o, d, t, leave[r], ahead, aside, index, rows, ball, at, weights)
                blended(values, at, weights, count, v)
                steps[s], transmittances[s] = t, transmittance
                transmittance *= ONE - v[A]
                t = later(t, 1, ahead, aside, ball)


@njit(parallel=True, fastmath=True, cache=True)
def _value_gradients(
    g_totals, g_distance, origins, directions, index, rows, values, ball, starts, steps, transmittances, points, first,
    out,
):  # fmt: skip
    """Gradient of each step's interpolated values: dL/dv = T g; alpha also gets what it occludes.

    first: of each step, the lower of the two voxels around it along x, counted from the grid's apron
    """
    block = rows.shape[1] - 2
    for r in prange(len(origins)):
        at, weights, v = np.empty(9, np.int64), np.empty(9, np.float32), np.empty(C, np.float32)
        hidden = ZERO  # sum over steps j behind step i of prod_{i<k<j} (1 - alpha_k) dL/dT_j
        for s in range(starts[r + 1] - 1, starts[r] - 1, -1):
            t = steps[s]
            x, y, z = placed(origins[r], directions[r], t, ball)
            points[s, 0], points[s, 1], points[s, 2] = x, y, z
            bx, by, bz, number = block_of(x, y, z, index, block)
            (cx, fx), (cy, fy), (cz, fz) = cell_of(x, bx, block), cell_of(y, by, block), cell_of(z, bz, block)
            count = corners(rows, max(number, np.int64(0)), cx, fx, cy, fy, cz, fz, at, weights)
            blended(values, at, weights, count, v)
            first[s] = block * bx + cx
            own = g_distance[r] * v[A] * t
            for c in range(C):
                own += g_totals[r, c] * v[c]
                out[s, c] = transmittances[s] * g_totals[r, c]
            out[s, A] += transmittances[s] * (g_distance[r] * t - hidden)
            hidden = own + (ONE - v[A]) * hidden


@njit(parallel=True, fastmath=True, cache=True)
def _spread(d_v, points, index, rows, order, starts, out):
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
                        out[row, c] += weight * d_v[s, c]


def forward(ctx, origins, directions, enter, leave, blocks, values, stop):
    ctx.blocks = blocks
    totals, distance = empty(len(origins), C), empty(len(origins))
    lengths = torch.zeros(len(origins), dtype=torch.int64)
    given = (x.detach().numpy() for x in (origins, directions, enter, leave, blocks.index, blocks.rows, values))
    _forward(*given, np.float32(blocks.ball), np.float32(stop), totals.numpy(), distance.numpy(), lengths.numpy())
    ctx.save_for_backward(origins, directions, enter, leave, values, lengths)
    return totals, distance


def backward(ctx, g_totals, g_distance):
    origins, directions, enter, leave, values, lengths = (x.detach().numpy() for x in ctx.saved_tensors)
    index, rows = ctx.blocks.index.numpy(), ctx.blocks.rows.numpy()
    starts = np.concatenate([np.zeros(1, np.int64), lengths.cumsum()])
    total, block = int(starts[-1]), ctx.blocks.block
    ball, first = np.float32(ctx.blocks.ball), np.empty(total, np.int32)
    steps, transmittances, points, d_v = (empty(total, *width).numpy() for width in ((), (), (3,), (C,)))
    _steps(origins, directions, enter, leave, index, rows, values, ball, starts, steps, transmittances)
    noted = starts, steps, transmittances, points, first
    _value_gradients(g_totals.numpy(), g_distance.numpy(), origins, directions, index, rows, values, ball, *noted, d_v)
    # Places of one slab of cells touch its voxels and the next one's first: see `sparse_grid`.
    order, slabs = slabs_of(first, block * index.shape[0] + 1)
    to_values = torch.zeros(values.shape)
    _spread(d_v, points, index, rows, order, slabs, to_values.numpy())
    return None, None, None, None, None, to_values, None


run = differentiable(forward, backward)
