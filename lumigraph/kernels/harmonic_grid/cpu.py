"""Numba. A row's 27 coefficients are two registers, the first 16 and the last 16 of them; the harmonics of a direction
are two more, each three times over and 0 where the registers overlap. So a sample's coefficients never touch memory."""

import numpy as np
import torch
from numba import njit, prange

from .._lanes import fetch, put, put_where, totals
from .._operation import differentiable, empty
from ..sparse_grid.cpu import CHUNK, corners, in_slabs
from ..spherical_harmonics import K00, K1, K20, K21, K22

ZERO, ONE, THREE = np.float32(0), np.float32(1), np.float32(3)
Y0, Y1, Y20, Y21, Y22 = (np.float32(k) for k in (K00, K1, K20, K21, K22))
WIDTH = 27  # coefficients of a row, colours next to each other
SECOND_REGISTER = 11  # where a row's second register begins
# Of the two registers: which lanes are of each colour, and in the last row, which are a row's own.
_PLACES = np.stack([np.arange(16), np.arange(SECOND_REGISTER, WIDTH)])  # in a row, of each lane
_MASKS = [*(_PLACES % 3 == colour for colour in range(3)), _PLACES >= [[0], [16]]]
LANES_OF = np.stack(_MASKS).astype(np.float32).reshape(-1)


@njit(inline="always")
def _basis(directions, i, out):
    """The nine harmonics of a direction, each three times, as two registers of 16 numbers."""
    x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
    out[0] = out[1] = out[2] = Y0
    out[3] = out[4] = out[5] = -Y1 * y
    out[6] = out[7] = out[8] = Y1 * z
    out[9] = out[10] = out[11] = -Y1 * x
    out[12] = out[13] = out[14] = Y21 * x * y
    out[15] = out[21] = out[22] = -Y21 * y * z
    out[23] = out[24] = out[25] = Y20 * (THREE * z * z - ONE)
    out[26] = out[27] = out[28] = -Y21 * x * z
    out[29] = out[30] = out[31] = Y22 * (x * x - y * y)


@njit(inline="always")
def _turned(directions, i, before):
    """True if the direction of sample i differs from that of sample `before`."""
    return (
        before < 0
        or directions[i, 0] != directions[before, 0]
        or directions[i, 1] != directions[before, 1]
        or directions[i, 2] != directions[before, 2]
    )


@njit(parallel=True, fastmath=True, cache=True)
def _look_up(points, directions, index, rows, density, harmonics, lanes_of, to_density, to_rgb):
    n = len(points)
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        at, weights = np.empty(9, np.int64), np.empty(9, np.float32)
        basis, colours = np.zeros(32, np.float32), np.zeros(16, np.float32)
        red0, red1 = fetch(lanes_of, 0), fetch(lanes_of, 16)
        green0, green1 = fetch(lanes_of, 32), fetch(lanes_of, 48)
        blue0, blue1 = fetch(lanes_of, 64), fetch(lanes_of, 80)
        before = -1
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            if _turned(directions, i, before):
                _basis(directions, i, basis)
            before = i
            b0, b1 = fetch(basis, 0), fetch(basis, 16)
            v0, v1, total = b0 * ZERO, b1 * ZERO, ZERO
            for k in range(corners(points, i, index, rows, at, weights)):
                row, weight = at[k], weights[k]
                total += weight * density[row]
                v0 = v0 + weight * fetch(harmonics, row * WIDTH)
                v1 = v1 + weight * fetch(harmonics, row * WIDTH + SECOND_REGISTER)
            v0, v1 = v0 * b0, v1 * b1
            put(colours, 0, totals((v0 * red0 + v1 * red1, v0 * green0 + v1 * green1, v0 * blue0 + v1 * blue1)))
            to_density[i] = total
            for c in range(3):
                to_rgb[i, c] = colours[c]


@njit(parallel=True, fastmath=True, cache=True)
def _gradient(d_density, d_rgb, points, directions, index, rows, order, starts, lanes_of, to_density, to_harmonics):
    for half in range(2):
        for pair in prange((len(starts) - 1) // 2):
            slab = 2 * pair + half
            at, weights, basis = np.empty(9, np.int64), np.empty(9, np.float32), np.zeros(32, np.float32)
            red0, red1 = fetch(lanes_of, 0), fetch(lanes_of, 16)
            green0, green1 = fetch(lanes_of, 32), fetch(lanes_of, 48)
            blue0, blue1 = fetch(lanes_of, 64), fetch(lanes_of, 80)
            own = fetch(lanes_of, 112) >= ONE
            before = -1
            for j in range(starts[slab], starts[slab + 1]):
                i = order[j]
                if _turned(directions, i, before):
                    _basis(directions, i, basis)
                before = i
                red, green, blue = d_rgb[i, 0], d_rgb[i, 1], d_rgb[i, 2]
                g0 = fetch(basis, 0) * (red * red0 + green * green0 + blue * blue0)
                g1 = fetch(basis, 16) * (red * red1 + green * green1 + blue * blue1)
                for k in range(corners(points, i, index, rows, at, weights)):
                    row, weight = at[k], weights[k]
                    to_density[row] += weight * d_density[i]
                    first, second = row * WIDTH, row * WIDTH + SECOND_REGISTER
                    v0, v1 = fetch(to_harmonics, first) + weight * g0, fetch(to_harmonics, second) + weight * g1
                    put(to_harmonics, first, v0)
                    put_where(own, to_harmonics, second, v1)


def forward(ctx, points, directions, nodes, density, harmonics):
    ctx.nodes, ctx.shapes = nodes, (density.shape, harmonics.shape)
    ctx.save_for_backward(points, directions)
    to_density, to_rgb = empty(len(points)), empty(len(points), 3)
    tables = density.detach().numpy(), harmonics.detach().view(-1).numpy()
    given = points.detach().numpy(), directions.detach().numpy(), nodes.index.numpy(), nodes.rows.numpy()
    _look_up(*given, *tables, LANES_OF, to_density.numpy(), to_rgb.numpy())
    return to_density, to_rgb


def backward(ctx, d_density, d_rgb):
    points, directions = (x.detach().numpy() for x in ctx.saved_tensors)
    to_density, to_harmonics = (torch.zeros(shape) for shape in ctx.shapes)
    index, rows = ctx.nodes.index.numpy(), ctx.nodes.rows.numpy()
    order, starts = in_slabs(points, index)
    out = to_density.numpy(), to_harmonics.view(-1).numpy()
    _gradient(d_density.numpy(), d_rgb.numpy(), points, directions, index, rows, order, starts, LANES_OF, *out)
    return None, None, None, to_density, to_harmonics


run = differentiable(forward, backward)
