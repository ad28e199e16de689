"""Triton: one program takes a block of points. Gradients of the grid meet in atomic adds."""

import torch
import triton
import triton.language as tl

from .._gpu import blocks, indices, launch, load_row, store_row
from .._operation import differentiable, empty
from ..sparse_grid.gpu import corner_of, slope_of, weight_of

BLOCK = tl.constexpr(64)


@triton.jit
def _along(x, box, axis: tl.constexpr, size):
    """Along one axis: the corner at or below each point, the fraction to the next, and whether it is inside."""
    x = (x - tl.load(box + axis)) * tl.load(box + 3 + axis)
    inside = (x > 0.0) & (x < size - 1)
    x = tl.minimum(tl.maximum(x, 0.0), (size - 1).to(tl.float32))
    corner = tl.minimum(x.to(tl.int32), size - 2)
    return corner, x - corner.to(tl.float32), inside


@triton.jit
def _cell_of(points, box, i, here, X, Y, Z):
    """Cell of a grid of X Y Z corners in a box, like `cell_of` of sparse grids."""
    x, y, z = load_row(points, i, here)
    cx, fx, inside_x = _along(x, box, 0, X)
    cy, fy, inside_y = _along(y, box, 1, Y)
    cz, fz, inside_z = _along(z, box, 2, Z)
    return (cx, cy, cz), (fx, fy, fz), (inside_x, inside_y, inside_z)


@triton.jit
def _entry(corner, Y, Z):
    return (corner[0].to(tl.int64) * Y + corner[1]) * Z + corner[2]


@triton.jit(do_not_specialize=["S", "X", "Y", "Z"])
def _forward(points, grid, box, out, S, X, Y, Z, C: tl.constexpr, CHANNELS: tl.constexpr):
    i, here = indices(S, BLOCK)
    c = tl.arange(0, CHANNELS)
    there = here[:, None] & (c < C)[None, :]
    cell, f, _ = _cell_of(points, box, i, here, X, Y, Z)
    total = tl.zeros([BLOCK, CHANNELS], tl.float32)
    for k in tl.static_range(8):
        weight = weight_of(k, f)
        entry = _entry(corner_of(k, cell), Y, Z)
        total += weight[:, None] * tl.load(grid + entry[:, None] * C + c[None, :], mask=there, other=0.0)
    tl.store(out + i[:, None] * C + c[None, :], total, mask=there)


@triton.jit(do_not_specialize=["S", "X", "Y", "Z"])
def _backward_grid(grad, points, box, d_grid, S, X, Y, Z, C: tl.constexpr, CHANNELS: tl.constexpr):
    i, here = indices(S, BLOCK)
    c = tl.arange(0, CHANNELS)
    there = here[:, None] & (c < C)[None, :]
    cell, f, _ = _cell_of(points, box, i, here, X, Y, Z)
    g = tl.load(grad + i[:, None] * C + c[None, :], mask=there, other=0.0)
    for k in tl.static_range(8):
        weight = weight_of(k, f)
        entry = _entry(corner_of(k, cell), Y, Z)
        tl.atomic_add(d_grid + entry[:, None] * C + c[None, :], weight[:, None] * g, mask=there, sem="relaxed")


@triton.jit(do_not_specialize=["S", "X", "Y", "Z"])
def _backward_points(grad, points, grid, box, d_points, S, X, Y, Z, C: tl.constexpr, CHANNELS: tl.constexpr):
    i, here = indices(S, BLOCK)
    c = tl.arange(0, CHANNELS)
    there = here[:, None] & (c < C)[None, :]
    cell, f, inside = _cell_of(points, box, i, here, X, Y, Z)
    g = tl.load(grad + i[:, None] * C + c[None, :], mask=there, other=0.0)
    dx = tl.zeros([BLOCK], tl.float32)
    dy = tl.zeros([BLOCK], tl.float32)
    dz = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(8):
        entry = _entry(corner_of(k, cell), Y, Z)
        value = tl.sum(g * tl.load(grid + entry[:, None] * C + c[None, :], mask=there, other=0.0), 1)
        slope = slope_of(k, f)
        dx, dy, dz = dx + slope[0] * value, dy + slope[1] * value, dz + slope[2] * value
    dx = tl.where(inside[0], dx * tl.load(box + 3), 0.0)
    dy = tl.where(inside[1], dy * tl.load(box + 4), 0.0)
    dz = tl.where(inside[2], dz * tl.load(box + 5), 0.0)
    store_row(d_points, i, (dx, dy, dz), here)


def forward(ctx, points, grid, box):
    (X, Y, Z, C), S = grid.shape, len(points)
    ctx.sizes = {"S": S, "X": X, "Y": Y, "Z": Z, "C": C, "CHANNELS": triton.next_power_of_2(C)}
    ctx.box = torch.stack([box[0], (torch.tensor([X, Y, Z], device=box.device) - 1) / (box[1] - box[0])])
    out = empty(S, C, device=points.device)
    launch(_forward, (blocks(S, BLOCK),), points, grid, ctx.box, out, **ctx.sizes)
    ctx.save_for_backward(points, grid)
    return out


def backward(ctx, grad):
    points, grid = ctx.saved_tensors
    programs, d_points, d_grid = (blocks(len(points), BLOCK),), None, None
    if ctx.needs_input_grad[0]:
        d_points = empty(*points.shape, device=points.device)
        launch(_backward_points, programs, grad, points, grid, ctx.box, d_points, **ctx.sizes)
    if ctx.needs_input_grad[1]:
        d_grid = torch.zeros_like(grid)
        launch(_backward_grid, programs, grad, points, ctx.box, d_grid, **ctx.sizes)
    return d_points, d_grid, None


run = differentiable(forward, backward)
