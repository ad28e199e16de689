"""Numba: threads share the directions. Output is coefficient-major, the layout for networks."""

import numpy as np
from numba import njit, prange
from numba.extending import overload

from .._lanes import LANES, LanesType, fetch, put
from .._operation import differentiable, empty
from . import K00, K1, K20, K21, K22, K30, K31, K32, K33

MAX_COEFFICIENTS = 16  # coefficients
BLOCK = 64  # directions whose coefficients go to their places together: far apart, these would not stay in a cache


def keep(out, k, x):
    """Store out[k] = x; x may be lanes and `out` rows of lanes."""
    if np.ndim(x):
        put(out, LANES * k, x)
    else:
        out[k] = x


def kept(out, k, like):
    """Load out[k]; `like` may be lanes and `out` rows of lanes."""
    return fetch(out, LANES * k) if np.ndim(like) else out[k]


@overload(keep, inline="always")
def _keep(out, k, x):
    def one(out, k, x):
        out[k] = x

    return (lambda out, k, x: put(out, LANES * k, x)) if isinstance(x, LanesType) else one


@overload(kept, inline="always")
def _kept(out, k, like):
    if isinstance(like, LanesType):
        return lambda out, k, like: fetch(out, LANES * k)
    return lambda out, k, like: out[k]


@njit(inline="always")
def basis(x, y, z, bands, out):
    """Write the polynomials at one direction, or at one in each lane."""
    keep(out, 0, 0.0 * x + K00)
    if bands > 1:
        keep(out, 1, -K1 * y)
        keep(out, 2, K1 * z)
        keep(out, 3, -K1 * x)
    if bands > 2:
        keep(out, 4, K21 * x * y)
        keep(out, 5, -K21 * y * z)
        keep(out, 6, K20 * (3.0 * z * z - 1.0))
        keep(out, 7, -K21 * x * z)
        keep(out, 8, K22 * (x * x - y * y))
    if bands > 3:
        keep(out, 9, -K33 * y * (3.0 * x * x - y * y))
        keep(out, 10, 2.0 * K32 * x * y * z)
        keep(out, 11, -K31 * y * (5.0 * z * z - 1.0))
        keep(out, 12, K30 * z * (5.0 * z * z - 3.0))
        keep(out, 13, -K31 * x * (5.0 * z * z - 1.0))
        keep(out, 14, K32 * z * (x * x - y * y))
        keep(out, 15, -K33 * x * (x * x - 3.0 * y * y))


@njit(inline="always")
def slope(x, y, z, bands, g):
    """Gradient of sum_k g_k Y_k in the direction, or in one for each lane."""
    dx = dy = dz = 0.0 * x
    if bands > 1:
        dx = dx - K1 * kept(g, 3, x)
        dy = dy - K1 * kept(g, 1, x)
        dz = dz + K1 * kept(g, 2, x)
    if bands > 2:
        g4, g5, g6, g7, g8 = kept(g, 4, x), kept(g, 5, x), kept(g, 6, x), kept(g, 7, x), kept(g, 8, x)
        dx = dx + K21 * (y * g4 - z * g7) + 2.0 * K22 * x * g8
        dy = dy + K21 * (x * g4 - z * g5) - 2.0 * K22 * y * g8
        dz = dz + 6.0 * K20 * z * g6 - K21 * (y * g5 + x * g7)
    if bands > 3:
        g9, g10, g11, g12 = kept(g, 9, x), kept(g, 10, x), kept(g, 11, x), kept(g, 12, x)
        g13, g14, g15 = kept(g, 13, x), kept(g, 14, x), kept(g, 15, x)
        sectoral, zonal = 3.0 * K33 * (x * x - y * y), K31 * (5.0 * z * z - 1.0)
        dx = dx + 2.0 * K32 * z * (y * g10 + x * g14) - 6.0 * K33 * x * y * g9 - sectoral * g15 - zonal * g13
        dy = dy + 2.0 * K32 * z * (x * g10 - y * g14) + 6.0 * K33 * x * y * g15 - sectoral * g9 - zonal * g11
        dz = dz + K32 * (2.0 * x * y * g10 + (x * x - y * y) * g14)
        dz = dz + 3.0 * K30 * (5.0 * z * z - 1.0) * g12 - 10.0 * K31 * z * (y * g11 + x * g13)
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
