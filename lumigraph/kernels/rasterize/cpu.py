"""Numba: a thread takes a run of tiles; blocks of 4 x 4 pixels are sixteen lanes; each Gaussian is drawn in the blocks
that its ellipse touches and that have not terminated.

Gradients of one Gaussian from one tile are summed in registers and stored separately; a second pass adds them up in
the order of tiles, so that no two threads add to one place and the result is the same each time.
"""

import math

import numpy as np
from numba import get_num_threads, njit, prange

from .._lanes import (
    SIXTEEN,
    ahead,
    bytes_between,
    exp2,
    fetch,
    filled,
    first_bit,
    highest,
    lowest,
    put,
    root,
    some,
    totals,
    where,
)
from .._operation import differentiable, empty
from ..project import MAX_ALPHA as _MAX_ALPHA
from ..project import MIN_ALPHA as _MIN_ALPHA

# Without "reassoc": see `exp2`.
FAST = {"cache": True, "nogil": True, "fastmath": {"contract", "nsz", "arcp"}, "error_model": "numpy"}
LANES, BLOCKS = 16, 64  # pixels of a block; blocks of the largest tile, in eight rows of eight
MIN_ALPHA, MAX_ALPHA = np.float32(_MIN_ALPHA), np.float32(_MAX_ALPHA)
ZERO, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)
TILE, PAIR = 8, 8  # about what a tile costs in pairs, and a pair in visits to a block, to share work out by
AHEAD = 6  # pairs from the one at hand to that whose row is asked of the memory
LOG2_E, LOG2_255, LN_4 = math.log2(math.e), math.log2(255), np.float32(math.log(4))
MIN_EXPONENT = np.float32(math.log2(_MIN_ALPHA))

# Rows of a table of constants: where a tile's pixels are, x by columns of blocks and y by rows of them; then a tile's
# rows of blocks, and right (+) and left (-) edges.
TABLE = np.zeros((18, LANES), np.float32)
TABLE[:8] = 4 * np.arange(8)[:, None] + np.tile(np.arange(4), 4) + 0.5
TABLE[8:16] = 4 * np.arange(8)[:, None] + np.repeat(np.arange(4), 4) + 0.5
TABLE[16], TABLE[17] = np.tile(4 * np.arange(8), 2), np.repeat([1, -1], 8)

# Columns of a Gaussian's row: exponent of 2 at (dx, dy) is BRIGHT - (ALONG (dx + SKEW dy))^2 - (DOWN dy)^2.
X, Y, ALONG, SKEW, DOWN, BRIGHT, RED, GREEN, BLUE, DEPTH, MAX_REACH, LIMIT = range(12)


@njit(parallel=True, **FAST)
def _pack(centres, conics, opacities, colours, depths, rows):
    """Pack each Gaussian's parameters into a row of sixteen numbers."""
    for i in prange(len(centres)):
        row = rows[i * LANES : (i + 1) * LANES]
        a, b, c = np.float64(conics[i, 0]), np.float64(conics[i, 1]), np.float64(conics[i, 2])
        if opacities[i] > 0 and a > 0:
            upright = max(c - b * b / a, 1e-30)  # in double precision, for needles leave little of it
            row[X], row[Y] = centres[i, 0], centres[i, 1]
            row[ALONG], row[SKEW] = math.sqrt(0.5 * LOG2_E * a), b / a
            row[DOWN] = math.sqrt(0.5 * LOG2_E * upright)
            row[BRIGHT] = math.log2(opacities[i])
            row[LIMIT] = row[BRIGHT] + LOG2_255
            # How far below the centre the ellipse reaches furthest to the right.
            row[MAX_REACH] = -b / c * math.sqrt(max(row[LIMIT], ZERO) / (0.5 * LOG2_E * upright) * c / a)
            for k in range(3):
                row[RED + k] = colours[i, k]
            row[DEPTH] = depths[i]
        else:
            row[:] = 0


@njit(inline="always")
def _blocks(rows, i, left, top, table):
    """Bit mask of a tile's blocks that the ellipse may touch: bit 8 r + c for column c of row r."""
    above = top + HALF - rows[i + Y]
    sign = fetch(table, 17 * LANES)
    upper = fetch(table, 16 * LANES) + above
    y = lowest(highest(sign * rows[i + MAX_REACH], upper), upper + np.float32(3))
    v = y * rows[i + DOWN]
    room = rows[i + LIMIT] - v * v
    edge = sign * root(highest(room, room * ZERO)) * (ONE / rows[i + ALONG]) - y * rows[i + SKEW]
    # Columns of a block are 0.5 to 3.5 from its left; where nothing is left of the ellipse, right is left of left.
    edge = (edge + (rows[i + X] - left - np.float32(2)) + sign * np.float32(1.5)) * np.float32(0.25)
    return bytes_between(where(room >= ZERO, edge, sign * np.float32(-100)))


@njit(inline="always")
def _frame(rows, i, left, top):
    """The exponent as two squares of linear functions of a pixel in the tile: slopes of the first, slope of the second,
    and both values at the tile's corner."""
    along, down = rows[i + ALONG], rows[i + DOWN]
    slant = along * rows[i + SKEW]
    x, y = np.float32(left) - rows[i + X], np.float32(top) - rows[i + Y]
    return along, slant, down, along * x + slant * y, down * y


@njit(inline="always")
def _bell(rows, i, frame, table, block):
    """The two linear functions, and the exponent of 2 in opacity exp(-q / 2), at pixels of a block."""
    along, slant, down, u, v = frame
    x, y = fetch(table, (block & 7) * LANES), fetch(table, (8 + (block >> 3)) * LANES)
    u, v = along * x + (slant * y + u), down * y + v
    return u, v, rows[i + BRIGHT] - v * v - u * u


@njit(inline="always")
def _alpha(exponent, transmittance, stop):
    return where((exponent >= MIN_EXPONENT) & (transmittance >= stop), lowest(exp2(exponent), MAX_ALPHA), ZERO)


@njit(inline="always")
def _ends(alpha, transmittance, stop):
    """Lanes in which the Gaussian at hand brings a ray below `stop`; with `exclusive` it then adds nothing."""
    return (transmittance >= stop) & (stop >= transmittance - alpha * transmittance)


@njit(inline="always")
def _span(n, side, first):
    """Number of a tile's rows or columns of blocks inside the picture."""
    return (min(side, n - first) + 3) // 4


@njit(inline="always")
def _place(x, y, planes):
    """Index of a pixel in plane 0 of its block, where each block has `planes` planes of 16 numbers."""
    return (y // 4 * 8 + x // 4) * planes * LANES + y % 4 * 4 + x % 4


@njit(inline="always")
def _all_blocks(columns, rows):
    found = np.uint64(0)
    for r in range(rows):
        found |= ((np.uint64(1) << np.uint64(columns)) - np.uint64(1)) << np.uint64(8 * r)
    return found


@njit(parallel=True, **FAST)
def _forward(rows, order, starts, shares, size, side, stop, exclusive, table, rgb, depth, opacity, masks, visits):
    width, height = size
    across = (width + side - 1) // side
    for share in prange(len(shares) - 1):
        state = np.empty(BLOCKS * 5 * LANES, np.float32)
        for k in range(shares[share], shares[share + 1]):
            left, top = k % across * side, k // across * side
            wide, high = _span(width, side, left), _span(height, side, top)
            alive = _all_blocks(wide, high)
            state[:] = 0
            for y in range(min(side, height - top)):
                for x in range(min(side, width - left)):
                    state[_place(x, y, 5)] = 1
            visited = 0
            for p in range(starts[k], starts[k + 1]):
                i = np.int64(order[p]) * LANES
                ahead(rows, np.int64(order[min(p + AHEAD, len(order) - 1)]) * LANES)
                todo = alive & _blocks(rows, i, np.float32(left), np.float32(top), table) if alive else alive
                masks[p] = todo
                if not todo:
                    continue
                frame = _frame(rows, i, left, top)
                while todo:
                    block = first_bit(todo)
                    todo &= todo - np.uint64(1)
                    at = block * (5 * LANES)
                    _, _, exponent = _bell(rows, i, frame, table, block)
                    transmittance = fetch(state, at)
                    alpha = _alpha(exponent, transmittance, stop)
                    if exclusive is not None:  # a ray that has ended keeps its transmittance, negative
                        ends = _ends(alpha, transmittance, stop)
                        alpha = where(ends, ZERO, alpha)
                        transmittance = where(ends, -ONE * transmittance, transmittance)
                    weight = alpha * transmittance
                    transmittance = transmittance - weight
                    put(state, at, transmittance)
                    for c in range(4):
                        to = at + (c + 1) * LANES
                        put(state, to, fetch(state, to) + weight * rows[i + RED + c])
                    if not some(transmittance >= stop):
                        alive &= ~(np.uint64(1) << np.uint64(block))
                    visited += 1
            visits[k] = visited
            for y in range(min(side, height - top)):
                for x in range(min(side, width - left)):
                    at = _place(x, y, 5)
                    opacity[top + y, left + x] = ONE - abs(state[at])
                    for c in range(3):
                        rgb[top + y, left + x, c] = state[at + (c + 1) * LANES]
                    depth[top + y, left + x] = state[at + 4 * LANES]


@njit(parallel=True, **FAST)
def _backward(
    to_rgb, to_depth, to_opacity, rgb, depth, opacity, rows, order, starts, shares, size, side, stop, exclusive, table,
    masks, sums, spread
):  # fmt: skip
    """Gradients, with c_i = dL/dw_i and a_i = opacity exp(-q / 2) where that is not clamped,

        dL / d ln a_i = w_i c_i - a_i / (1 - a_i) sum_{j>i} w_j c_j

    weighted by 1, dx, dy, dx^2, dx dy, dy^2 and summed over pixels; beside them sum w_i dL/drgb and sum w_i dL/ddepth.
    With `spread` also sums of the absolute values of the gradient in the centre.
    """
    width, height = size
    across = (width + side - 1) // side
    for share in prange(len(shares) - 1):
        state = np.empty(BLOCKS * 7 * LANES, np.float32)
        for k in range(shares[share], shares[share + 1]):
            left, top = k % across * side, k // across * side
            state[:] = 0
            for y in range(min(side, height - top)):
                for x in range(min(side, width - left)):
                    at = _place(x, y, 7)
                    py, px = top + y, left + x
                    sum_gw = to_depth[py, px] * depth[py, px] + to_opacity[py, px] * opacity[py, px]
                    for c in range(3):
                        sum_gw += to_rgb[py, px, c] * rgb[py, px, c]
                        state[at + (c + 2) * LANES] = to_rgb[py, px, c]
                    state[at], state[at + LANES] = 1, sum_gw
                    state[at + 5 * LANES], state[at + 6 * LANES] = to_depth[py, px], to_opacity[py, px]
            for p in range(starts[k], starts[k + 1]):
                todo = masks[p]
                if not todo:
                    continue
                i = np.int64(order[p]) * LANES
                ahead(rows, np.int64(order[min(p + AHEAD, len(order) - 1)]) * LANES)
                frame = _frame(rows, i, left, top)
                s = su = sv = suu = suv = svv = red = green = blue = far = across_x = across_y = filled(ZERO, SIXTEEN)
                while todo:
                    block = first_bit(todo)
                    todo &= todo - np.uint64(1)
                    at = block * (7 * LANES)
                    u, v, exponent = _bell(rows, i, frame, table, block)
                    transmittance = fetch(state, at)
                    alpha = _alpha(exponent, transmittance, stop)
                    if exclusive is not None:
                        ends = _ends(alpha, transmittance, stop)
                        alpha = where(ends, ZERO, alpha)
                        transmittance = where(ends, -ONE * transmittance, transmittance)
                    weight = alpha * transmittance
                    put(state, at, transmittance - weight)
                    r, g = fetch(state, at + 2 * LANES), fetch(state, at + 3 * LANES)
                    b, d = fetch(state, at + 4 * LANES), fetch(state, at + 5 * LANES)
                    gw = fetch(state, at + 6 * LANES) + r * rows[i + RED] + g * rows[i + GREEN]
                    gw = (gw + b * rows[i + BLUE] + d * rows[i + DEPTH]) * weight
                    sum_gw = fetch(state, at + LANES) - gw
                    put(state, at + LANES, sum_gw)
                    slope = gw - alpha * sum_gw / (ONE - alpha)
                    slope = where(alpha < MAX_ALPHA, slope, ZERO)
                    gu, gv = slope * u, slope * v
                    if spread is not None:
                        x, y = frame[0] * gu, frame[1] * gu + frame[2] * gv
                        across_x, across_y = across_x + highest(x, -ONE * x), across_y + highest(y, -ONE * y)
                    s, su, sv = s + slope, su + gu, sv + gv
                    suu, suv, svv = suu + gu * u, suv + gu * v, svv + gv * v
                    red, green, blue, far = red + weight * r, green + weight * g, blue + weight * b, far + weight * d
                put(sums, p * LANES, totals((s, su, sv, suu, suv, svv, red, green, blue, far, across_x, across_y)))


@njit(parallel=True, **FAST)
def _gather(
    sums, masks, order, rows, opacities, parts, to_centres, to_conics, to_opacities, to_colours, to_depths, spread
):
    """Gradients from the sums. Each thread adds up its own Gaussians, in the order of tiles."""
    n = len(to_depths)
    for part in prange(parts):
        begin, end = n * part // parts, n * (part + 1) // parts
        total = np.zeros((end - begin) * LANES, np.float32)
        for p in range(len(order)):
            i = order[p]
            if begin <= i < end and masks[p]:
                at = (i - begin) * LANES
                put(total, at, fetch(total, at) + fetch(sums, p * LANES))
        for i in range(begin, end):
            s = total[(i - begin) * LANES : (i - begin + 1) * LANES]
            along, skew, down = rows[i * LANES + ALONG], rows[i * LANES + SKEW], rows[i * LANES + DOWN]
            to_centres[i, 0] = LN_4 * along * s[1]
            to_centres[i, 1] = LN_4 * (along * skew * s[1] + down * s[2])
            if along > 0:
                dudy, dydy = s[4] / (along * down), s[5] / (down * down)
                dxdy = dudy - skew * dydy
                to_conics[i, 0] = -HALF * (s[3] / (along * along) - skew * (dudy + dxdy))
                to_conics[i, 1], to_conics[i, 2] = -dxdy, -HALF * dydy
            else:
                to_conics[i] = 0
            to_opacities[i] = s[0] / opacities[i] if opacities[i] > 0 else ZERO
            for k in range(3):
                to_colours[i, k] = s[6 + k]
            to_depths[i] = s[9]
            if spread is not None:
                spread[i, 0] += LN_4 * s[10]
                spread[i, 1] += LN_4 * s[11]


def _shares(work):
    """Runs of tiles, one for each thread, of about equal work."""
    threads, done = get_num_threads(), np.cumsum(work)
    cuts = np.searchsorted(done, done[-1] * np.arange(1, threads) / threads)
    return np.concatenate([[0], cuts, [len(work)]])


def forward(ctx, centres, conics, opacities, colours, depths, tiles, stop, exclusive=False, spread=None):
    width, height = tiles.size
    order, starts = tiles.order.numpy(), tiles.starts.numpy()
    rows = np.empty(len(centres) * LANES, np.float32)
    _pack(*(x.detach().numpy() for x in (centres, conics, opacities, colours, depths)), rows)
    rgb, depth, opacity = empty(height, width, 3), empty(height, width), empty(height, width)
    work = np.diff(starts) + TILE
    masks, visits = np.empty(len(order), np.uint64), np.empty(len(work), np.int64)
    ctx.numbers = tiles.size, tiles.side, np.float32(stop), True if exclusive else None, TABLE.ravel()
    ctx.spread = None if spread is None else spread.numpy()
    pictures = (x.numpy() for x in (rgb, depth, opacity))
    _forward(rows, order, starts, _shares(work), *ctx.numbers, *pictures, masks, visits)
    ctx.kept = rows, order, starts, masks, _shares(visits + PAIR * work)
    ctx.save_for_backward(rgb, depth, opacity, opacities)
    return rgb, depth, opacity


def backward(ctx, *grads):
    (rows, order, starts, masks, shares), saved = ctx.kept, [x.detach().numpy() for x in ctx.saved_tensors]
    n, sums = len(saved[3]), np.empty(len(order) * LANES, np.float32)
    _backward(
        *(x.numpy() for x in grads), *saved[:3], rows, order, starts, shares, *ctx.numbers, masks, sums, ctx.spread
    )
    results = empty(n, 2), empty(n, 3), empty(n), empty(n, 3), empty(n)
    _gather(sums, masks, order, rows, saved[3], get_num_threads(), *(x.numpy() for x in results), ctx.spread)
    return *results, None, None, None, None


run = differentiable(forward, backward)
