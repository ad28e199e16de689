"""Triton: one program takes a block of points on one level. Gradients of the table meet in atomic adds."""

from __future__ import annotations

from functools import cache

import torch
import triton
import triton.language as tl
from torch import Tensor

from .._dispatch import empty
from . import PRIMES, HashLevels

PRIME_Y, PRIME_Z = tl.constexpr(PRIMES[1]), tl.constexpr(PRIMES[2])
BLOCK = 128


@triton.jit
def _axis(points, i, axis: tl.constexpr, here, n):
    """Along one axis: the cell that holds each point, its place in the cell, whether it lies inside the cube."""
    x = tl.load(points + 3 * i + axis, mask=here, other=0.0)
    inside = (x >= 0.0) & (x <= 1.0)
    x = tl.minimum(tl.maximum(x, 0.0), 1.0) * n
    cell = tl.minimum(x.to(tl.int32), n - 1)
    return cell, x - cell.to(tl.float32), inside


@triton.jit
def _entry(cx, cy, cz, n, mask):
    """A corner's row in its level's part of the table; mask is 2^log2_entries - 1, or 0 on a dense level."""
    x, y, z = cx.to(tl.uint32), cy.to(tl.uint32), cz.to(tl.uint32)
    side = (n + 1).to(tl.uint32)
    dense = x + side * (y + side * z)
    hashed = (x ^ (y * PRIME_Y) ^ (z * PRIME_Z)) & mask.to(tl.uint32)
    return tl.where(mask == 0, dense, hashed).to(tl.int64)


@triton.jit
def _weight(fraction, corner: tl.constexpr):
    return fraction if corner == 1 else 1 - fraction


@triton.jit(do_not_specialize=["S"])
def _forward(
    points,
    table,
    pyramid,
    out,
    S,
    L: tl.constexpr,
    F: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    level = tl.program_id(1)
    n = tl.load(pyramid + 3 * level).to(tl.int32)
    offset, mask = tl.load(pyramid + 3 * level + 1), tl.load(pyramid + 3 * level + 2)
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    f = tl.arange(0, FEATURES)
    here = i < S
    there = here[:, None] & (f < F)[None, :]
    cx, fx, _ = _axis(points, i, 0, here, n)
    cy, fy, _ = _axis(points, i, 1, here, n)
    cz, fz, _ = _axis(points, i, 2, here, n)
    total = tl.zeros([BLOCK, FEATURES], tl.float32)
    for corner in tl.static_range(8):
        weight = _weight(fx, corner % 2) * _weight(fy, corner // 2 % 2) * _weight(fz, corner // 4)
        entry = offset + _entry(cx + corner % 2, cy + corner // 2 % 2, cz + corner // 4, n, mask)
        total += weight[:, None] * tl.load(table + entry[:, None] * F + f[None, :], mask=there, other=0.0)
    tl.store(out + i[:, None] * (L * F) + level * F + f[None, :], total, mask=there)


@triton.jit(do_not_specialize=["S"])
def _backward_table(
    grad,
    points,
    pyramid,
    d_table,
    S,
    L: tl.constexpr,
    F: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    level = tl.program_id(1)
    n = tl.load(pyramid + 3 * level).to(tl.int32)
    offset, mask = tl.load(pyramid + 3 * level + 1), tl.load(pyramid + 3 * level + 2)
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    f = tl.arange(0, FEATURES)
    here = i < S
    there = here[:, None] & (f < F)[None, :]
    cx, fx, _ = _axis(points, i, 0, here, n)
    cy, fy, _ = _axis(points, i, 1, here, n)
    cz, fz, _ = _axis(points, i, 2, here, n)
    g = tl.load(grad + i[:, None] * (L * F) + level * F + f[None, :], mask=there, other=0.0)
    for corner in tl.static_range(8):
        weight = _weight(fx, corner % 2) * _weight(fy, corner // 2 % 2) * _weight(fz, corner // 4)
        entry = offset + _entry(cx + corner % 2, cy + corner // 2 % 2, cz + corner // 4, n, mask)
        tl.atomic_add(d_table + entry[:, None] * F + f[None, :], weight[:, None] * g, mask=there, sem="relaxed")


@triton.jit(do_not_specialize=["S"])
def _backward_points(
    grad,
    points,
    table,
    pyramid,
    d_points,
    S,
    L: tl.constexpr,
    F: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Here one program sees all levels, so that it can sum over them."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    f = tl.arange(0, FEATURES)
    here = i < S
    there = here[:, None] & (f < F)[None, :]
    dx = tl.zeros([BLOCK], tl.float32)
    dy = tl.zeros([BLOCK], tl.float32)
    dz = tl.zeros([BLOCK], tl.float32)
    for level in range(L):
        n = tl.load(pyramid + 3 * level).to(tl.int32)
        offset, mask = tl.load(pyramid + 3 * level + 1), tl.load(pyramid + 3 * level + 2)
        cx, fx, inside_x = _axis(points, i, 0, here, n)
        cy, fy, inside_y = _axis(points, i, 1, here, n)
        cz, fz, inside_z = _axis(points, i, 2, here, n)
        g = tl.load(grad + i[:, None] * (L * F) + level * F + f[None, :], mask=there, other=0.0)
        for corner in tl.static_range(8):
            wx, wy, wz = _weight(fx, corner % 2), _weight(fy, corner // 2 % 2), _weight(fz, corner // 4)
            entry = offset + _entry(cx + corner % 2, cy + corner // 2 % 2, cz + corner // 4, n, mask)
            along = n * tl.sum(g * tl.load(table + entry[:, None] * F + f[None, :], mask=there, other=0.0), 1)
            dx += tl.where(inside_x, (corner % 2 * 2 - 1) * wy * wz * along, 0.0)
            dy += tl.where(inside_y, (corner // 2 % 2 * 2 - 1) * wx * wz * along, 0.0)
            dz += tl.where(inside_z, (corner // 4 * 2 - 1) * wx * wy * along, 0.0)
    tl.store(d_points + 3 * i, dx, mask=here)
    tl.store(d_points + 3 * i + 1, dy, mask=here)
    tl.store(d_points + 3 * i + 2, dz, mask=here)


@cache
def _pyramid(levels: HashLevels, device: torch.device) -> Tensor:
    """(L, 3) int64: cells per side, first entry, hash mask (0 where dense)."""
    most = 2**levels.log2_entries
    rows = [
        (n, offset, 0 if (n + 1) ** 3 <= most else most - 1)
        for n, offset in zip(levels.resolutions, levels.offsets[:-1], strict=True)
    ]
    return torch.tensor(rows, device=device)


class _HashEncode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, points, table, levels):
        L, F = levels.levels, levels.features
        out = empty(len(points), L * F, device=points.device)
        ctx.sizes = {"S": len(points), "L": L, "F": F, "FEATURES": triton.next_power_of_2(F), "BLOCK": BLOCK}
        ctx.pyramid = _pyramid(levels, points.device)
        if len(points):
            _forward[(triton.cdiv(len(points), BLOCK), L)](points, table, ctx.pyramid, out, **ctx.sizes)
        ctx.save_for_backward(points, table)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        points, table = ctx.saved_tensors
        grad, blocks = grad.contiguous(), triton.cdiv(len(points), BLOCK)
        d_points = d_table = None
        if ctx.needs_input_grad[0]:
            d_points = empty(*points.shape, device=points.device)
            if blocks:
                _backward_points[(blocks,)](grad, points, table, ctx.pyramid, d_points, **ctx.sizes)
        if ctx.needs_input_grad[1]:
            d_table = torch.zeros_like(table)
            if blocks:
                _backward_table[(blocks, ctx.sizes["L"])](grad, points, ctx.pyramid, d_table, **ctx.sizes)
        return d_points, d_table, None


def run(points: Tensor, table: Tensor, levels: HashLevels) -> Tensor:
    return _HashEncode.apply(points.contiguous(), table.contiguous(), levels)
