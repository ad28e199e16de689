"""Triton: one lane takes one direction."""

import triton
import triton.language as tl

from .._gpu import blocks, indices, launch, load_row, store_row
from .._operation import differentiable, empty
from . import K00, K1, K20, K21, K22, K30, K31, K32, K33

Y00, Y1, Y20, Y21, Y22 = (tl.constexpr(k) for k in (K00, K1, K20, K21, K22))
Y30, Y31, Y32, Y33 = (tl.constexpr(k) for k in (K30, K31, K32, K33))
BLOCK = tl.constexpr(128)


@triton.jit
def harmonic(k: tl.constexpr, x, y, z):
    """Y_k, one of the sixteen harmonics, at directions."""
    if k == 0:
        Y = tl.zeros_like(x) + Y00
    elif k == 1:
        Y = y * -Y1
    elif k == 2:
        Y = z * Y1
    elif k == 3:
        Y = x * -Y1
    elif k == 4:
        Y = x * y * Y21
    elif k == 5:
        Y = y * z * -Y21
    elif k == 6:
        Y = (3 * z * z - 1) * Y20
    elif k == 7:
        Y = x * z * -Y21
    elif k == 8:
        Y = (x * x - y * y) * Y22
    elif k == 9:
        Y = y * (3 * x * x - y * y) * -Y33
    elif k == 10:
        Y = x * y * z * (2 * Y32)
    elif k == 11:
        Y = y * (5 * z * z - 1) * -Y31
    elif k == 12:
        Y = z * (5 * z * z - 3) * Y30
    elif k == 13:
        Y = x * (5 * z * z - 1) * -Y31
    elif k == 14:
        Y = z * (x * x - y * y) * Y32
    else:
        Y = x * (x * x - 3 * y * y) * -Y33
    return Y


@triton.jit
def harmonic_slope(k: tl.constexpr, x, y, z):
    """Gradient of Y_k in x, y and z."""
    zero = tl.zeros_like(x)
    if k == 0:
        dY = zero, zero, zero
    elif k == 1:
        dY = zero, zero - Y1, zero
    elif k == 2:
        dY = zero, zero, zero + Y1
    elif k == 3:
        dY = zero - Y1, zero, zero
    elif k == 4:
        dY = y * Y21, x * Y21, zero
    elif k == 5:
        dY = zero, z * -Y21, y * -Y21
    elif k == 6:
        dY = zero, zero, z * (6 * Y20)
    elif k == 7:
        dY = z * -Y21, zero, x * -Y21
    elif k == 8:
        dY = x * (2 * Y22), y * (-2 * Y22), zero
    elif k == 9:
        dY = x * y * (-6 * Y33), (x * x - y * y) * (-3 * Y33), zero
    elif k == 10:
        dY = y * z * (2 * Y32), x * z * (2 * Y32), x * y * (2 * Y32)
    elif k == 11:
        dY = zero, (5 * z * z - 1) * -Y31, y * z * (-10 * Y31)
    elif k == 12:
        dY = zero, zero, (5 * z * z - 1) * (3 * Y30)
    elif k == 13:
        dY = (5 * z * z - 1) * -Y31, zero, x * z * (-10 * Y31)
    elif k == 14:
        dY = x * z * (2 * Y32), y * z * (-2 * Y32), (x * x - y * y) * Y32
    else:
        dY = (x * x - y * y) * (-3 * Y33), x * y * (6 * Y33), zero
    return dY


@triton.jit(do_not_specialize=["R"])
def _forward(directions, out, R, BANDS: tl.constexpr):
    r, here = indices(R, BLOCK)
    x, y, z = load_row(directions, r, here)
    for k in tl.static_range(BANDS * BANDS):
        tl.store(out + r * (BANDS * BANDS) + k, harmonic(k, x, y, z), mask=here)


@triton.jit(do_not_specialize=["R"])
def _backward(grad, directions, d_directions, R, BANDS: tl.constexpr):
    r, here = indices(R, BLOCK)
    x, y, z = load_row(directions, r, here)
    dx, dy, dz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    for k in tl.static_range(1, BANDS * BANDS):
        g = tl.load(grad + r * (BANDS * BANDS) + k, mask=here, other=0.0)
        Y_x, Y_y, Y_z = harmonic_slope(k, x, y, z)
        dx, dy, dz = dx + g * Y_x, dy + g * Y_y, dz + g * Y_z
    store_row(d_directions, r, (dx, dy, dz), here)


def forward(ctx, directions, bands):
    ctx.save_for_backward(directions)
    ctx.bands = bands
    out = empty(len(directions), bands**2, device=directions.device)
    launch(_forward, (blocks(len(out), BLOCK),), directions, out, len(out), BANDS=bands)
    return out


def backward(ctx, grad):
    (directions,) = ctx.saved_tensors
    d_directions = empty(*directions.shape, device=directions.device)
    launch(_backward, (blocks(len(grad), BLOCK),), grad, directions, d_directions, len(grad), BANDS=ctx.bands)
    return d_directions, None


run = differentiable(forward, backward)
