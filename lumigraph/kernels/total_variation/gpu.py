"""Triton: one program takes a block of nodes. Sums and gradients meet in atomic adds."""

import torch
import triton
import triton.language as tl

from .._gpu import blocks, launch
from .._operation import differentiable
from ..sparse_grid.gpu import row_of
from . import EPSILON

EPSILON_ = tl.constexpr(EPSILON)
BLOCK = tl.constexpr(64)


@triton.jit
def _after(index, rows, x, y, z, row, X, Y, Z):
    """Rows of the nodes at (x, y, z), or each node's own `row` for none, which makes the difference 0."""
    inside = (row >= 0) & (x < X) & (y < Y) & (z < Z)
    after = row_of(index, rows, (x, y, z), inside, Y, Z)
    return tl.where(after >= 0, after, row)


@triton.jit(do_not_specialize=["K"])
def _vary(
    chosen, index, rows, values, total, out, K, X, Y, Z, C: tl.constexpr, WIDTH: tl.constexpr, SLOPED: tl.constexpr
):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    c = tl.arange(0, WIDTH)[None, :]
    number = tl.load(chosen + i, mask=i < K, other=0)
    x, y, z = number // (Y * Z), number // Z % Y, number % Z
    row = row_of(index, rows, (x, y, z), i < K, Y, Z)
    right = _after(index, rows, x + 1, y, z, row, X, Y, Z)
    down = _after(index, rows, x, y + 1, z, row, X, Y, Z)
    ahead = _after(index, rows, x, y, z + 1, row, X, Y, Z)
    there = (row >= 0)[:, None] & (c < C)
    value = tl.load(values + row[:, None] * C + c, mask=there, other=0.0)
    dx = tl.load(values + right[:, None] * C + c, mask=there, other=0.0) - value
    dy = tl.load(values + down[:, None] * C + c, mask=there, other=0.0) - value
    dz = tl.load(values + ahead[:, None] * C + c, mask=there, other=0.0) - value
    length = tl.sqrt(dx * dx + dy * dy + dz * dz + EPSILON_)
    tl.atomic_add(total, tl.sum(tl.where(there, length, 0.0)), sem="relaxed")
    if SLOPED:
        tl.atomic_add(out + row[:, None] * C + c, -(dx + dy + dz) / length, mask=there, sem="relaxed")
        tl.atomic_add(out + right[:, None] * C + c, dx / length, mask=there, sem="relaxed")
        tl.atomic_add(out + down[:, None] * C + c, dy / length, mask=there, sem="relaxed")
        tl.atomic_add(out + ahead[:, None] * C + c, dz / length, mask=there, sem="relaxed")


def forward(ctx, chosen, nodes, values):
    channels, sloped = values.shape[1], ctx.needs_input_grad[2]
    ctx.count = max(len(chosen), 1)
    total = torch.zeros((), device=values.device)
    slope = torch.zeros_like(values) if sloped else total
    meta = {"C": channels, "WIDTH": triton.next_power_of_2(channels), "SLOPED": sloped}
    given = chosen, nodes.index.contiguous(), nodes.named, values, total, slope, len(chosen), *nodes.index.shape
    launch(_vary, (blocks(len(chosen), BLOCK),), *given, **meta)
    ctx.save_for_backward(slope)
    return total / ctx.count


def backward(ctx, grad):
    (slope,) = ctx.saved_tensors
    return None, None, slope * (grad / ctx.count)


run = differentiable(forward, backward)
