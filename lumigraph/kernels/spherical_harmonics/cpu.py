"""Numba: threads share the directions. One coefficient of all directions after another, as networks like them."""

import numpy as np
from numba import njit, prange

from .._operation import differentiable, empty
from . import K00, K1, K20, K21, K22, K30, K31, K32, K33

MAX_COEFFICIENTS = 16  # coefficients
BLOCK = 64  # directions whose coefficients go to their places together: far apart, these would not stay in a cache


@njit(inline="always")
def basis(x, y, z, bands, out):
    """The polynomials at one direction."""
    out[0] = K00
    if bands > 1:
        out[1] = -K1 * y
        out[2] = K1 * z
        out[3] = -K1 * x
    if bands > 2:
        out[4] = K21 * x * y
        out[5] = -K21 * y * z
        out[6] = K20 * (3 * z * z - 1)
        out[7] = -K21 * x * z
        out[8] = K22 * (x * x - y * y)
    if bands > 3:
        out[9] = -K33 * y * (3 * x * x - y * y)
        out[10] = 2 * K32 * x * y * z
        out[11] = -K31 * y * (5 * z * z - 1)
        out[12] = K30 * z * (5 * z * z - 3)
        out[13] = -K31 * x * (5 * z * z - 1)
        out[14] = K32 * z * (x * x - y * y)
        out[15] = -K33 * x * (x * x - 3 * y * y)


@njit(inline="always")
def slope(x, y, z, bands, g):
    """Gradient of sum_k g_k Y_k in the direction."""
    dx = dy = dz = 0.0
    if bands > 1:
        dx -= K1 * g[3]
        dy -= K1 * g[1]
        dz += K1 * g[2]
    if bands > 2:
        dx += K21 * (y * g[4] - z * g[7]) + 2 * K22 * x * g[8]
        dy += K21 * (x * g[4] - z * g[5]) - 2 * K22 * y * g[8]
        dz += 6 * K20 * z * g[6] - K21 * (y * g[5] + x * g[7])
    if bands > 3:
        sectoral, zonal = 3 * K33 * (x * x - y * y), K31 * (5 * z * z - 1)
        dx += 2 * K32 * z * (y * g[10] + x * g[14]) - 6 * K33 * x * y * g[9] - sectoral * g[15] - zonal * g[13]
        dy += 2 * K32 * z * (x * g[10] - y * g[14]) + 6 * K33 * x * y * g[15] - sectoral * g[9] - zonal * g[11]
        dz += K32 * (2 * x * y * g[10] + (x * x - y * y) * g[14])
        dz += 3 * K30 * (5 * z * z - 1) * g[12] - 10 * K31 * z * (y * g[11] + x * g[13])
    return dx, dy, dz


@njit(parallel=True, fastmath=True, cache=True)
def _forward(directions, bands, out):
    for part in prange(-(-len(directions) // BLOCK)):
        first, some = part * BLOCK, np.empty((MAX_COEFFICIENTS, BLOCK), np.float32)
        count = min(BLOCK, len(directions) - first)
        for r in range(count):
            at = first + r
            basis(directions[at, 0], directions[at, 1], directions[at, 2], bands, some[:, r])
        for k in range(bands**2):
            out[k, first : first + count] = some[k, :count]


@njit(parallel=True, fastmath=True, cache=True)
def _backward(grad, directions, bands, d_directions):
    for r in prange(len(directions)):
        x, y, z = slope(directions[r, 0], directions[r, 1], directions[r, 2], bands, grad[r])
        d_directions[r, 0], d_directions[r, 1], d_directions[r, 2] = x, y, z


def forward(ctx, directions, bands):
    ctx.save_for_backward(directions)
    ctx.bands = bands
    out = empty(bands**2, len(directions))
    _forward(directions.numpy(), bands, out.numpy())
    return out.t()


def backward(ctx, grad):
    (directions,) = ctx.saved_tensors
    d_directions = empty(*directions.shape)
    _backward(grad.numpy(), directions.numpy(), ctx.bands, d_directions.numpy())
    return d_directions, None


run = differentiable(forward, backward)
