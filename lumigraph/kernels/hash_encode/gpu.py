"""Triton: one program takes a block of points on one level. Gradients of the table meet in atomic adds."""

from functools import cache

import torch
import triton
import triton.language as tl
from torch import Tensor

from .._gpu import blocks, indices, launch, store_row
from .._operation import differentiable, empty
from ..sparse_grid.gpu import cell_of, corner_of, slope_of, weight_of
from . import PRIMES, HashLevels

PRIME_Y, PRIME_Z = tl.constexpr(PRIMES[1]), tl.constexpr(PRIMES[2])
BLOCK = tl.constexpr(128)


@triton.jit
def _entry(corner, n, mask):
    """A corner's row in its level's part of the table; mask is 2^log2_entries - 1, or 0 on a dense level."""
    x, y, z = corner[0].to(tl.uint32), corner[1].to(tl.uint32), corner[2].to(tl.uint32)
    side = (n + 1).to(tl.uint32)
    dense = x + side * (y + side * z)
    hashed = (x ^ (y * PRIME_Y) ^ (z * PRIME_Z)) & mask.to(tl.uint32)
    return tl.where(mask == 0, dense, hashed).to(tl.int64)


@triton.jit(do_not_specialize=["S"])
def _forward(points, table, pyramid, out, S, L: tl.constexpr, F: tl.constexpr, FEATURES: tl.constexpr):
    level = tl.program_id(1)
    n = tl.load(pyramid + 3 * level).to(tl.int32)
    offset, mask = tl.load(pyramid + 3 * level + 1), tl.load(pyramid + 3 * level + 2)
    i, here = indices(S, BLOCK)
    feature = tl.arange(0, FEATURES)
    there = here[:, None] & (feature < F)[None, :]
    cell, f, _ = cell_of(points, i, here, n, n, n)
    total = tl.zeros([BLOCK, FEATURES], tl.float32)
    for k in tl.static_range(8):
        weight = weight_of(k, f)
        entry = offset + _entry(corner_of(k, cell), n, mask)
        total += weight[:, None] * tl.load(table + entry[:, None] * F + feature[None, :], mask=there, other=0.0)
    tl.store(out + i[:, None] * (L * F) + level * F + feature[None, :], total, mask=there)


@triton.jit(do_not_specialize=["S"])
def _backward_table(grad, points, pyramid, d_table, S, L: tl.constexpr, F: tl.constexpr, FEATURES: tl.constexpr):
    level = tl.program_id(1)
    n = tl.load(pyramid + 3 * level).to(tl.int32)
    offset, mask = tl.load(pyramid + 3 * level + 1), tl.load(pyramid + 3 * level + 2)
    i, here = indices(S, BLOCK)
    feature = tl.arange(0, FEATURES)
    there = here[:, None] & (feature < F)[None, :]
    cell, f, _ = cell_of(points, i, here, n, n, n)
    g = tl.load(grad + i[:, None] * (L * F) + level * F + feature[None, :], mask=there, other=0.0)
    for k in tl.static_range(8):
        weight = weight_of(k, f)
        entry = offset + _entry(corner_of(k, cell), n, mask)
        tl.atomic_add(d_table + entry[:, None] * F + feature[None, :], weight[:, None] * g, mask=there, sem="relaxed")


@triton.jit(do_not_specialize=["S"])
def _backward_points(
    grad, points, table, pyramid, d_points, S, L: tl.constexpr, F: tl.constexpr, FEATURES: tl.constexpr
):
    """Gradient of points. One program takes all levels, so that it can sum over them."""
    i, here = indices(S, BLOCK)
    feature = tl.arange(0, FEATURES)
    there = here[:, None] & (feature < F)[None, :]
    dx = tl.zeros([BLOCK], tl.float32)
    dy = tl.zeros([BLOCK], tl.float32)
    dz = tl.zeros([BLOCK], tl.float32)
    for level in range(L):
        n = tl.load(pyramid + 3 * level).to(tl.int32)
        offset, mask = tl.load(pyramid + 3 * level + 1), tl.load(pyramid + 3 * level + 2)
        cell, f, inside = cell_of(points, i, here, n, n, n)
        g = tl.load(grad + i[:, None] * (L * F) + level * F + feature[None, :], mask=there, other=0.0)
        for k in tl.static_range(8):
            entry = offset + _entry(corner_of(k, cell), n, mask)
            along = n * tl.sum(g * tl.load(table + entry[:, None] * F + feature[None, :], mask=there, other=0.0), 1)
            slope = slope_of(k, f)
            dx += tl.where(inside[0], slope[0] * along, 0.0)
            dy += tl.where(inside[1], slope[1] * along, 0.0)
            dz += tl.where(inside[2], slope[2] * along, 0.0)
    store_row(d_points, i, (dx, dy, dz), here)


@cache
def _pyramid(levels: HashLevels, device: torch.device) -> Tensor:
    """(L, 3) int64: cells per side, first entry, hash mask (0 where dense)."""
    most, rows = 2**levels.log2_entries, zip(levels.resolutions, levels.offsets[:-1], strict=True)
    return torch.tensor([(n, first, 0 if (n + 1) ** 3 <= most else most - 1) for n, first in rows], device=device)


def forward(ctx, points, table, levels):
    L, F = levels.levels, levels.features
    out = empty(len(points), L * F, device=points.device)
    ctx.sizes = {"S": len(points), "L": L, "F": F, "FEATURES": triton.next_power_of_2(F)}
    ctx.pyramid = _pyramid(levels, points.device)
    launch(_forward, (blocks(len(points), BLOCK), L), points, table, ctx.pyramid, out, **ctx.sizes)
    ctx.save_for_backward(points, table)
    return out


def backward(ctx, grad):
    points, table = ctx.saved_tensors
    programs, d_points, d_table = blocks(len(points), BLOCK), None, None
    if ctx.needs_input_grad[0]:
        d_points = empty(*points.shape, device=points.device)
        launch(_backward_points, (programs,), grad, points, table, ctx.pyramid, d_points, **ctx.sizes)
    if ctx.needs_input_grad[1]:
        d_table = torch.zeros_like(table)
        launch(_backward_table, (programs, ctx.sizes["L"]), grad, points, ctx.pyramid, d_table, **ctx.sizes)
    return d_points, d_table, None


run = differentiable(forward, backward)
