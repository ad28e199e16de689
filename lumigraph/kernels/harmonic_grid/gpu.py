"""Triton: one program takes a block of samples. Gradients of the rows meet in atomic adds."""

import torch
import triton
import triton.language as tl

from .._gpu import blocks, indices, launch, load_row
from .._operation import differentiable, empty
from ..sparse_grid.gpu import cell_of, corner_of, row_of, weight_of
from ..spherical_harmonics.gpu import harmonic

BLOCK = tl.constexpr(64)
WIDTH = tl.constexpr(27)  # coefficients of a row, colours next to each other


@triton.jit
def _basis(directions, i, here, c):
    """The nine harmonics of each direction, each three times."""
    x, y, z = load_row(directions, i[:, None], here[:, None])
    basis = tl.zeros_like(x)
    for k in tl.static_range(9):
        basis = tl.where(c[None, :] // 3 == k, harmonic(k, x, y, z), basis)
    return basis


@triton.jit(do_not_specialize=["S"])
def _forward(points, directions, index, rows, density, harmonics, to_density, to_rgb, S, X, Y, Z):
    i, here = indices(S, BLOCK)
    c = tl.arange(0, 32)
    cell, f, _ = cell_of(points, i, here, X - 1, Y - 1, Z - 1)
    sigma = tl.zeros([BLOCK], tl.float32)
    total = tl.zeros([BLOCK, 32], tl.float32)
    for k in tl.static_range(8):
        weight = weight_of(k, f)
        row = row_of(index, rows, corner_of(k, cell), here, Y, Z)
        there = (row >= 0)[:, None] & (c < WIDTH)[None, :]
        sigma += weight * tl.load(density + row, mask=row >= 0, other=0.0)
        total += weight[:, None] * tl.load(harmonics + row[:, None] * WIDTH + c[None, :], mask=there, other=0.0)
    total *= _basis(directions, i, here, c)
    tl.store(to_density + i, sigma, mask=here)
    for colour in tl.static_range(3):
        seen = tl.sum(tl.where(c[None, :] % 3 == colour, total, 0.0), 1)
        tl.store(to_rgb + 3 * i + colour, seen, mask=here)


@triton.jit(do_not_specialize=["S"])
def _backward(d_sigma, d_rgb, points, directions, index, rows, d_density, d_harmonics, S, X, Y, Z):
    i, here = indices(S, BLOCK)
    c = tl.arange(0, 32)
    cell, f, _ = cell_of(points, i, here, X - 1, Y - 1, Z - 1)
    g_sigma = tl.load(d_sigma + i, mask=here, other=0.0)
    g = tl.load(d_rgb + 3 * i[:, None] + c[None, :] % 3, mask=here[:, None], other=0.0)
    g *= _basis(directions, i, here, c)
    for k in tl.static_range(8):
        weight = weight_of(k, f)
        row = row_of(index, rows, corner_of(k, cell), here, Y, Z)
        there = (row >= 0)[:, None] & (c < WIDTH)[None, :]
        tl.atomic_add(d_density + row, weight * g_sigma, mask=row >= 0, sem="relaxed")
        tl.atomic_add(d_harmonics + row[:, None] * WIDTH + c[None, :], weight[:, None] * g, mask=there, sem="relaxed")


def forward(ctx, points, directions, nodes, density, harmonics):
    ctx.index, ctx.shapes = (nodes.index.contiguous(), nodes.named), (density.shape, harmonics.shape)
    ctx.sizes = (len(points), *nodes.index.shape)
    ctx.save_for_backward(points, directions)
    out = empty(len(points), device=points.device), empty(len(points), 3, device=points.device)
    ctx.grid = (blocks(len(points), BLOCK),)
    launch(_forward, ctx.grid, points, directions, *ctx.index, density, harmonics, *out, *ctx.sizes)
    return out


def backward(ctx, *grads):
    points, directions = ctx.saved_tensors
    out = [torch.zeros(shape, device=points.device) for shape in ctx.shapes]
    launch(_backward, ctx.grid, *grads, points, directions, *ctx.index, *out, *ctx.sizes)
    return None, None, None, *out


run = differentiable(forward, backward)
