"""Triton: one program takes a block of samples. Gradients of the values meet in atomic adds."""

import torch
import triton
import triton.language as tl

from .._gpu import blocks, indices, launch, load_row, store_row
from .._operation import differentiable, empty

BLOCK = tl.constexpr(64)


@triton.jit
def _along(x, cells):
    """Along one axis: the cell of each point, and the fractional position within it."""
    x = tl.minimum(tl.maximum(x, 0.0), 1.0) * cells
    cell = tl.minimum(x.to(tl.int32), cells - 1)
    return cell, x - cell.to(tl.float32)


@triton.jit
def cell_of(points, i, here, X, Y, Z):
    """Cell of each point in a grid of X Y Z nodes, fractional position, and the axes along which it is inside."""
    x, y, z = load_row(points, i, here)
    cx, fx = _along(x, X)  # one pair a line: Triton 3.6 assigns to no nested tuple
    cy, fy = _along(y, Y)
    cz, fz = _along(z, Z)
    inside = (x >= 0.0) & (x <= 1.0), (y >= 0.0) & (y <= 1.0), (z >= 0.0) & (z <= 1.0)
    return (cx, cy, cz), (fx, fy, fz), inside


@triton.jit
def corner_of(k: tl.constexpr, cell):
    """Corner k of a cell; the bits of k are its sides along x, y and z."""
    return cell[0] + k % 2, cell[1] + k // 2 % 2, cell[2] + k // 4


@triton.jit
def _shares(k: tl.constexpr, f):
    x = f[0] if k % 2 == 1 else 1 - f[0]
    y = f[1] if k // 2 % 2 == 1 else 1 - f[1]
    z = f[2] if k // 4 == 1 else 1 - f[2]
    return x, y, z


@triton.jit
def weight_of(k: tl.constexpr, f):
    """Trilinear weight of corner k at a place f in the cell."""
    x, y, z = _shares(k, f)
    return x * y * z


@triton.jit
def slope_of(k: tl.constexpr, f):
    """Derivative of `weight_of` along each axis."""
    x, y, z = _shares(k, f)
    return (k % 2 * 2 - 1) * y * z, (k // 2 % 2 * 2 - 1) * x * z, (k // 4 * 2 - 1) * x * y


@triton.jit
def row_of(index, rows, node, here, Y, Z):
    """The row of a node, -1 where it has none."""
    number = (node[0].to(tl.int64) * Y + node[1]) * Z + node[2]
    row = tl.load(index + number, mask=here, other=-1)
    return tl.load(rows + row, mask=row >= 0, other=-1).to(tl.int64)


@triton.jit(do_not_specialize=["S"])
def _forward(points, index, rows, values, out, S, X, Y, Z, C: tl.constexpr, WIDTH: tl.constexpr):
    i, here = indices(S, BLOCK)
    c = tl.arange(0, WIDTH)
    cell, f, _ = cell_of(points, i, here, X - 1, Y - 1, Z - 1)
    total = tl.zeros([BLOCK, WIDTH], tl.float32)
    for k in tl.static_range(8):
        weight = weight_of(k, f)
        row = row_of(index, rows, corner_of(k, cell), here, Y, Z)
        there = (row >= 0)[:, None] & (c < C)[None, :]
        total += weight[:, None] * tl.load(values + row[:, None] * C + c[None, :], mask=there, other=0.0)
    tl.store(out + i[:, None] * C + c[None, :], total, mask=here[:, None] & (c < C)[None, :])


@triton.jit(do_not_specialize=["S"])
def _backward_values(grad, points, index, rows, d_values, S, X, Y, Z, C: tl.constexpr, WIDTH: tl.constexpr):
    i, here = indices(S, BLOCK)
    c = tl.arange(0, WIDTH)
    cell, f, _ = cell_of(points, i, here, X - 1, Y - 1, Z - 1)
    g = tl.load(grad + i[:, None] * C + c[None, :], mask=here[:, None] & (c < C)[None, :], other=0.0)
    for k in tl.static_range(8):
        weight = weight_of(k, f)
        row = row_of(index, rows, corner_of(k, cell), here, Y, Z)
        there = (row >= 0)[:, None] & (c < C)[None, :]
        tl.atomic_add(d_values + row[:, None] * C + c[None, :], weight[:, None] * g, mask=there, sem="relaxed")


@triton.jit(do_not_specialize=["S"])
def _backward_points(grad, points, index, rows, values, d_points, S, X, Y, Z, C: tl.constexpr, WIDTH: tl.constexpr):
    i, here = indices(S, BLOCK)
    c = tl.arange(0, WIDTH)
    cell, f, inside = cell_of(points, i, here, X - 1, Y - 1, Z - 1)
    g = tl.load(grad + i[:, None] * C + c[None, :], mask=here[:, None] & (c < C)[None, :], other=0.0)
    dx = tl.zeros([BLOCK], tl.float32)
    dy = tl.zeros([BLOCK], tl.float32)
    dz = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(8):
        row = row_of(index, rows, corner_of(k, cell), here, Y, Z)
        there = (row >= 0)[:, None] & (c < C)[None, :]
        along = tl.sum(g * tl.load(values + row[:, None] * C + c[None, :], mask=there, other=0.0), 1)
        slope = slope_of(k, f)
        dx, dy, dz = dx + slope[0] * along, dy + slope[1] * along, dz + slope[2] * along
    dx = tl.where(inside[0], dx * (X - 1), 0.0)
    dy = tl.where(inside[1], dy * (Y - 1), 0.0)
    dz = tl.where(inside[2], dz * (Z - 1), 0.0)
    store_row(d_points, i, (dx, dy, dz), here)


def forward(ctx, points, nodes, values):
    channels = values.shape[1]
    ctx.index = nodes.index.contiguous(), nodes.named
    ctx.sizes = (len(points), *nodes.index.shape)
    ctx.meta = {"C": channels, "WIDTH": triton.next_power_of_2(max(channels, 1))}
    ctx.save_for_backward(points, values)
    out = empty(len(points), channels, device=points.device)
    launch(_forward, (blocks(len(points), BLOCK),), points, *ctx.index, values, out, *ctx.sizes, **ctx.meta)
    return out


def backward(ctx, grad):
    points, values = ctx.saved_tensors
    grid, d_points, d_values = (blocks(len(points), BLOCK),), None, None
    if ctx.needs_input_grad[0]:
        d_points = empty(*points.shape, device=points.device)
        launch(_backward_points, grid, grad, points, *ctx.index, values, d_points, *ctx.sizes, **ctx.meta)
    if ctx.needs_input_grad[2]:
        d_values = torch.zeros_like(values)
        launch(_backward_values, grid, grad, points, *ctx.index, d_values, *ctx.sizes, **ctx.meta)
    return d_points, None, d_values


run = differentiable(forward, backward)
