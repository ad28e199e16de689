"""Triton: one program takes a block of samples. Gradients of the values meet in atomic adds."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from .._dispatch import empty
from . import Nodes

BLOCK = 64


@triton.jit
def cell_of(points, i, axis: tl.constexpr, here, cells):
    """Along one axis: the cell that holds each point, its place in the cell, whether it lies inside the cube."""
    x = tl.load(points + 3 * i + axis, mask=here, other=0.0)
    inside = (x >= 0.0) & (x <= 1.0)
    x = tl.minimum(tl.maximum(x, 0.0), 1.0) * cells
    cell = tl.minimum(x.to(tl.int32), cells - 1)
    return cell, x - cell.to(tl.float32), inside


@triton.jit
def row_of(index, rows, x, y, z, here, Y, Z):
    """The row of a node, -1 where it has none."""
    number = (x.to(tl.int64) * Y + y) * Z + z
    row = tl.load(index + number, mask=here, other=-1)
    return tl.load(rows + row, mask=row >= 0, other=-1).to(tl.int64)


@triton.jit
def share(fraction, side: tl.constexpr):
    return fraction if side == 1 else 1 - fraction


@triton.jit(do_not_specialize=["S"])
def _forward(points, index, rows, values, out, S, X, Y, Z, C: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    c = tl.arange(0, WIDTH)
    here = i < S
    cx, fx, _ = cell_of(points, i, 0, here, X - 1)
    cy, fy, _ = cell_of(points, i, 1, here, Y - 1)
    cz, fz, _ = cell_of(points, i, 2, here, Z - 1)
    total = tl.zeros([BLOCK, WIDTH], tl.float32)
    for corner in tl.static_range(8):
        weight = share(fx, corner % 2) * share(fy, corner // 2 % 2) * share(fz, corner // 4)
        row = row_of(index, rows, cx + corner % 2, cy + corner // 2 % 2, cz + corner // 4, here, Y, Z)
        there = (row >= 0)[:, None] & (c < C)[None, :]
        total += weight[:, None] * tl.load(values + row[:, None] * C + c[None, :], mask=there, other=0.0)
    tl.store(out + i[:, None] * C + c[None, :], total, mask=here[:, None] & (c < C)[None, :])


@triton.jit(do_not_specialize=["S"])
def _backward_values(
    grad, points, index, rows, d_values, S, X, Y, Z, C: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr
):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    c = tl.arange(0, WIDTH)
    here = i < S
    cx, fx, _ = cell_of(points, i, 0, here, X - 1)
    cy, fy, _ = cell_of(points, i, 1, here, Y - 1)
    cz, fz, _ = cell_of(points, i, 2, here, Z - 1)
    g = tl.load(grad + i[:, None] * C + c[None, :], mask=here[:, None] & (c < C)[None, :], other=0.0)
    for corner in tl.static_range(8):
        weight = share(fx, corner % 2) * share(fy, corner // 2 % 2) * share(fz, corner // 4)
        row = row_of(index, rows, cx + corner % 2, cy + corner // 2 % 2, cz + corner // 4, here, Y, Z)
        there = (row >= 0)[:, None] & (c < C)[None, :]
        tl.atomic_add(d_values + row[:, None] * C + c[None, :], weight[:, None] * g, mask=there, sem="relaxed")


@triton.jit(do_not_specialize=["S"])
def _backward_points(
    grad, points, index, rows, values, d_points, S, X, Y, Z, C: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr
):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    c = tl.arange(0, WIDTH)
    here = i < S
    cx, fx, inside_x = cell_of(points, i, 0, here, X - 1)
    cy, fy, inside_y = cell_of(points, i, 1, here, Y - 1)
    cz, fz, inside_z = cell_of(points, i, 2, here, Z - 1)
    g = tl.load(grad + i[:, None] * C + c[None, :], mask=here[:, None] & (c < C)[None, :], other=0.0)
    dx = tl.zeros([BLOCK], tl.float32)
    dy = tl.zeros([BLOCK], tl.float32)
    dz = tl.zeros([BLOCK], tl.float32)
    for corner in tl.static_range(8):
        wx, wy, wz = share(fx, corner % 2), share(fy, corner // 2 % 2), share(fz, corner // 4)
        row = row_of(index, rows, cx + corner % 2, cy + corner // 2 % 2, cz + corner // 4, here, Y, Z)
        there = (row >= 0)[:, None] & (c < C)[None, :]
        along = tl.sum(g * tl.load(values + row[:, None] * C + c[None, :], mask=there, other=0.0), 1)
        dx += (corner % 2 * 2 - 1) * wy * wz * along
        dy += (corner // 2 % 2 * 2 - 1) * wx * wz * along
        dz += (corner // 4 * 2 - 1) * wx * wy * along
    tl.store(d_points + 3 * i, tl.where(inside_x, dx * (X - 1), 0.0), mask=here)
    tl.store(d_points + 3 * i + 1, tl.where(inside_y, dy * (Y - 1), 0.0), mask=here)
    tl.store(d_points + 3 * i + 2, tl.where(inside_z, dz * (Z - 1), 0.0), mask=here)


class _SparseGrid(torch.autograd.Function):
    @staticmethod
    def forward(ctx, points, nodes, values):
        channels = values.shape[1]
        ctx.index = nodes.index.contiguous(), nodes.named
        ctx.sizes = (len(points), *nodes.index.shape)
        ctx.meta = {"C": channels, "WIDTH": triton.next_power_of_2(max(channels, 1)), "BLOCK": BLOCK}
        ctx.save_for_backward(points, values)
        out = empty(len(points), channels, device=points.device)
        if len(points):
            _forward[(triton.cdiv(len(points), BLOCK),)](points, *ctx.index, values, out, *ctx.sizes, **ctx.meta)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        points, values = ctx.saved_tensors
        grad, blocks = grad.contiguous(), (triton.cdiv(len(points), BLOCK),)
        d_points = d_values = None
        if ctx.needs_input_grad[0]:
            d_points = empty(*points.shape, device=points.device)
            if len(points):
                _backward_points[blocks](grad, points, *ctx.index, values, d_points, *ctx.sizes, **ctx.meta)
        if ctx.needs_input_grad[2]:
            d_values = torch.zeros_like(values)
            if len(points):
                _backward_values[blocks](grad, points, *ctx.index, d_values, *ctx.sizes, **ctx.meta)
        return d_points, None, d_values


def run(points: Tensor, nodes: Nodes, values: Tensor) -> Tensor:
    return _SparseGrid.apply(points.contiguous(), nodes, values.contiguous())
