"""Triton: one lane takes one direction."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from .._dispatch import empty
from . import K00 as _K00
from . import K1 as _K1
from . import K20 as _K20
from . import K21 as _K21
from . import K22 as _K22
from . import K30 as _K30
from . import K31 as _K31
from . import K32 as _K32
from . import K33 as _K33

K00, K1 = tl.constexpr(_K00), tl.constexpr(_K1)
K20, K21, K22 = tl.constexpr(_K20), tl.constexpr(_K21), tl.constexpr(_K22)
K30, K31, K32, K33 = tl.constexpr(_K30), tl.constexpr(_K31), tl.constexpr(_K32), tl.constexpr(_K33)
BLOCK = 128


@triton.jit(do_not_specialize=["R"])
def _forward(directions, out, R, BANDS: tl.constexpr, BLOCK: tl.constexpr):
    r = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = r < R
    x = tl.load(directions + 3 * r, mask=here, other=0.0)
    y = tl.load(directions + 3 * r + 1, mask=here, other=0.0)
    z = tl.load(directions + 3 * r + 2, mask=here, other=0.0)
    row = out + r * (BANDS * BANDS)
    tl.store(row, tl.full([BLOCK], K00, tl.float32), mask=here)
    if BANDS > 1:
        tl.store(row + 1, y * -K1, mask=here)
        tl.store(row + 2, z * K1, mask=here)
        tl.store(row + 3, x * -K1, mask=here)
    if BANDS > 2:
        tl.store(row + 4, x * y * K21, mask=here)
        tl.store(row + 5, y * z * -K21, mask=here)
        tl.store(row + 6, (3 * z * z - 1) * K20, mask=here)
        tl.store(row + 7, x * z * -K21, mask=here)
        tl.store(row + 8, (x * x - y * y) * K22, mask=here)
    if BANDS > 3:
        tl.store(row + 9, y * (3 * x * x - y * y) * -K33, mask=here)
        tl.store(row + 10, x * y * z * (2 * K32), mask=here)
        tl.store(row + 11, y * (5 * z * z - 1) * -K31, mask=here)
        tl.store(row + 12, z * (5 * z * z - 3) * K30, mask=here)
        tl.store(row + 13, x * (5 * z * z - 1) * -K31, mask=here)
        tl.store(row + 14, z * (x * x - y * y) * K32, mask=here)
        tl.store(row + 15, x * (x * x - 3 * y * y) * -K33, mask=here)


@triton.jit(do_not_specialize=["R"])
def _backward(grad, directions, d_directions, R, BANDS: tl.constexpr, BLOCK: tl.constexpr):
    r = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = r < R
    x = tl.load(directions + 3 * r, mask=here, other=0.0)
    y = tl.load(directions + 3 * r + 1, mask=here, other=0.0)
    z = tl.load(directions + 3 * r + 2, mask=here, other=0.0)
    row = grad + r * (BANDS * BANDS)
    dx = tl.zeros([BLOCK], tl.float32)
    dy = tl.zeros([BLOCK], tl.float32)
    dz = tl.zeros([BLOCK], tl.float32)
    if BANDS > 1:
        dx -= tl.load(row + 3, mask=here, other=0.0) * K1
        dy -= tl.load(row + 1, mask=here, other=0.0) * K1
        dz += tl.load(row + 2, mask=here, other=0.0) * K1
    if BANDS > 2:
        g4 = tl.load(row + 4, mask=here, other=0.0)
        g5 = tl.load(row + 5, mask=here, other=0.0)
        g6 = tl.load(row + 6, mask=here, other=0.0)
        g7 = tl.load(row + 7, mask=here, other=0.0)
        g8 = tl.load(row + 8, mask=here, other=0.0)
        dx += (y * g4 - z * g7) * K21 + x * g8 * (2 * K22)
        dy += (x * g4 - z * g5) * K21 - y * g8 * (2 * K22)
        dz += z * g6 * (6 * K20) - (y * g5 + x * g7) * K21
    if BANDS > 3:
        g9 = tl.load(row + 9, mask=here, other=0.0)
        g10 = tl.load(row + 10, mask=here, other=0.0)
        g11 = tl.load(row + 11, mask=here, other=0.0)
        g12 = tl.load(row + 12, mask=here, other=0.0)
        g13 = tl.load(row + 13, mask=here, other=0.0)
        g14 = tl.load(row + 14, mask=here, other=0.0)
        g15 = tl.load(row + 15, mask=here, other=0.0)
        sectoral = (x * x - y * y) * (3 * K33)
        zonal = (5 * z * z - 1) * K31
        dx += z * (y * g10 + x * g14) * (2 * K32) - x * y * g9 * (6 * K33) - sectoral * g15 - zonal * g13
        dy += z * (x * g10 - y * g14) * (2 * K32) + x * y * g15 * (6 * K33) - sectoral * g9 - zonal * g11
        dz += (2 * x * y * g10 + (x * x - y * y) * g14) * K32
        dz += (5 * z * z - 1) * g12 * (3 * K30) - z * (y * g11 + x * g13) * (10 * K31)
    tl.store(d_directions + 3 * r, dx, mask=here)
    tl.store(d_directions + 3 * r + 1, dy, mask=here)
    tl.store(d_directions + 3 * r + 2, dz, mask=here)


class _SphericalHarmonics(torch.autograd.Function):
    @staticmethod
    def forward(ctx, directions, bands):
        ctx.save_for_backward(directions)
        ctx.bands = bands
        out = empty(len(directions), bands**2, device=directions.device)
        if len(out):
            _forward[(triton.cdiv(len(out), BLOCK),)](directions, out, len(out), BANDS=bands, BLOCK=BLOCK)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        (directions,) = ctx.saved_tensors
        d_directions = empty(*directions.shape, device=directions.device)
        if len(grad):
            grid = (triton.cdiv(len(grad), BLOCK),)
            _backward[grid](grad.contiguous(), directions, d_directions, len(grad), BANDS=ctx.bands, BLOCK=BLOCK)
        return d_directions, None


def run(directions: Tensor, bands: int) -> Tensor:
    return _SphericalHarmonics.apply(directions.contiguous(), bands)
