"""Triton: one program takes a block of points. Gradients of the grid meet in atomic adds."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from .._dispatch import empty

BLOCK = 64


@triton.jit
def _axis(points, box, i, axis: tl.constexpr, here, size):
    """Along one axis: the corner at or below each point, the place between it and the next, whether it lies inside."""
    x = tl.load(points + 3 * i + axis, mask=here, other=0.0)
    x = (x - tl.load(box + axis)) * tl.load(box + 3 + axis)
    inside = (x > 0.0) & (x < size - 1)
    x = tl.minimum(tl.maximum(x, 0.0), (size - 1).to(tl.float32))
    corner = tl.minimum(x.to(tl.int32), size - 2)
    return corner, x - corner.to(tl.float32), inside


@triton.jit
def _weight(fraction, side: tl.constexpr):
    return fraction if side == 1 else 1 - fraction


@triton.jit
def _entry(cx, cy, cz, Y, Z):
    return (cx.to(tl.int64) * Y + cy) * Z + cz


@triton.jit(do_not_specialize=["S", "X", "Y", "Z"])
def _forward(points, grid, box, out, S, X, Y, Z, C: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    f = tl.arange(0, CHANNELS)
    here = i < S
    there = here[:, None] & (f < C)[None, :]
    cx, fx, _ = _axis(points, box, i, 0, here, X)
    cy, fy, _ = _axis(points, box, i, 1, here, Y)
    cz, fz, _ = _axis(points, box, i, 2, here, Z)
    total = tl.zeros([BLOCK, CHANNELS], tl.float32)
    for corner in tl.static_range(8):
        weight = _weight(fx, corner % 2) * _weight(fy, corner // 2 % 2) * _weight(fz, corner // 4)
        entry = _entry(cx + corner % 2, cy + corner // 2 % 2, cz + corner // 4, Y, Z)
        total += weight[:, None] * tl.load(grid + entry[:, None] * C + f[None, :], mask=there, other=0.0)
    tl.store(out + i[:, None] * C + f[None, :], total, mask=there)


@triton.jit(do_not_specialize=["S", "X", "Y", "Z"])
def _backward_grid(grad, points, box, d_grid, S, X, Y, Z, C: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    f = tl.arange(0, CHANNELS)
    here = i < S
    there = here[:, None] & (f < C)[None, :]
    cx, fx, _ = _axis(points, box, i, 0, here, X)
    cy, fy, _ = _axis(points, box, i, 1, here, Y)
    cz, fz, _ = _axis(points, box, i, 2, here, Z)
    g = tl.load(grad + i[:, None] * C + f[None, :], mask=there, other=0.0)
    for corner in tl.static_range(8):
        weight = _weight(fx, corner % 2) * _weight(fy, corner // 2 % 2) * _weight(fz, corner // 4)
        entry = _entry(cx + corner % 2, cy + corner // 2 % 2, cz + corner // 4, Y, Z)
        tl.atomic_add(d_grid + entry[:, None] * C + f[None, :], weight[:, None] * g, mask=there, sem="relaxed")


@triton.jit(do_not_specialize=["S", "X", "Y", "Z"])
def _backward_points(
    grad, points, grid, box, d_points, S, X, Y, Z, C: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr
):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    f = tl.arange(0, CHANNELS)
    here = i < S
    there = here[:, None] & (f < C)[None, :]
    cx, fx, inside_x = _axis(points, box, i, 0, here, X)
    cy, fy, inside_y = _axis(points, box, i, 1, here, Y)
    cz, fz, inside_z = _axis(points, box, i, 2, here, Z)
    g = tl.load(grad + i[:, None] * C + f[None, :], mask=there, other=0.0)
    dx = tl.zeros([BLOCK], tl.float32)
    dy = tl.zeros([BLOCK], tl.float32)
    dz = tl.zeros([BLOCK], tl.float32)
    for corner in tl.static_range(8):
        wx, wy, wz = _weight(fx, corner % 2), _weight(fy, corner // 2 % 2), _weight(fz, corner // 4)
        entry = _entry(cx + corner % 2, cy + corner // 2 % 2, cz + corner // 4, Y, Z)
        value = tl.sum(g * tl.load(grid + entry[:, None] * C + f[None, :], mask=there, other=0.0), 1)
        dx += (corner % 2 * 2 - 1) * wy * wz * value
        dy += (corner // 2 % 2 * 2 - 1) * wx * wz * value
        dz += (corner // 4 * 2 - 1) * wx * wy * value
    tl.store(d_points + 3 * i, tl.where(inside_x, dx * tl.load(box + 3), 0.0), mask=here)
    tl.store(d_points + 3 * i + 1, tl.where(inside_y, dy * tl.load(box + 4), 0.0), mask=here)
    tl.store(d_points + 3 * i + 2, tl.where(inside_z, dz * tl.load(box + 5), 0.0), mask=here)


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx, points, grid, box):
        (X, Y, Z, C), S = grid.shape, len(points)
        ctx.sizes = {"S": S, "X": X, "Y": Y, "Z": Z, "C": C, "CHANNELS": triton.next_power_of_2(C), "BLOCK": BLOCK}
        ctx.box = torch.stack([box[0], (torch.tensor([X, Y, Z], device=box.device) - 1) / (box[1] - box[0])])
        out = empty(S, C, device=points.device)
        if S:
            _forward[(triton.cdiv(S, BLOCK),)](points, grid, ctx.box, out, **ctx.sizes)
        ctx.save_for_backward(points, grid)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        points, grid = ctx.saved_tensors
        grad, blocks = grad.contiguous(), triton.cdiv(len(points), BLOCK)
        d_points = d_grid = None
        if ctx.needs_input_grad[0]:
            d_points = empty(*points.shape, device=points.device)
            if blocks:
                _backward_points[(blocks,)](grad, points, grid, ctx.box, d_points, **ctx.sizes)
        if ctx.needs_input_grad[1]:
            d_grid = torch.zeros_like(grid)
            if blocks:
                _backward_grid[(blocks,)](grad, points, ctx.box, d_grid, **ctx.sizes)
        return d_points, d_grid, None


def run(points: Tensor, grid: Tensor, box: Tensor) -> Tensor:
    return _Lookup.apply(points.contiguous(), grid.contiguous(), box)
