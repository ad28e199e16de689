"""Triton: one program takes one ray, a block of samples at a time."""

import triton
import triton.language as tl

from .._gpu import launch
from .._operation import differentiable, empty

BLOCK = tl.constexpr(32)  # samples; most rays of a trained scene need one or two blocks


@triton.jit
def _load(weights, middles, lengths, i, b):
    w = tl.load(weights + i, mask=i < b, other=0.0)
    m = tl.load(middles + i, mask=i < b, other=0.0)
    return w, m, tl.load(lengths + i, mask=i < b, other=0.0)


@triton.jit
def _forward(weights, middles, lengths, ray_starts, total):
    r = tl.program_id(0).to(tl.int64)
    a, b = tl.load(ray_starts + r), tl.load(ray_starts + r + 1)
    weight, moment, found = 0.0, 0.0, 0.0
    for i0 in range(a, b, BLOCK):
        w, m, d = _load(weights, middles, lengths, i0 + tl.arange(0, BLOCK), b)
        before = weight + tl.cumsum(w, 0) - w
        moved = moment + tl.cumsum(w * m, 0) - w * m
        found += tl.sum(w * (2 * (m * before - moved) + w * d / 3), 0)
        weight += tl.sum(w, 0)
        moment += tl.sum(w * m, 0)
    tl.store(total + r, found)


@triton.jit
def _backward(d_total, weights, middles, lengths, ray_starts, d_weights):
    r = tl.program_id(0).to(tl.int64)
    a, b = tl.load(ray_starts + r), tl.load(ray_starts + r + 1)
    g = tl.load(d_total + r)
    weight, moment = 0.0, 0.0  # of all samples before, less those behind
    for i0 in range(a, b, BLOCK):
        w, m, d = _load(weights, middles, lengths, i0 + tl.arange(0, BLOCK), b)
        weight -= tl.sum(w, 0)
        moment -= tl.sum(w * m, 0)
    for i0 in range(a, b, BLOCK):
        i = i0 + tl.arange(0, BLOCK)
        w, m, d = _load(weights, middles, lengths, i, b)
        around = weight + 2 * tl.cumsum(w, 0) - w
        moved = moment + 2 * tl.cumsum(w * m, 0) - w * m
        tl.store(d_weights + i, 2 * g * (m * around - moved + w * d / 3), mask=i < b)
        weight += 2 * tl.sum(w, 0)
        moment += 2 * tl.sum(w * m, 0)


def forward(ctx, weights, middles, lengths, ray_starts):
    total = empty(len(ray_starts) - 1, device=weights.device)
    launch(_forward, (len(total),), weights, middles, lengths, ray_starts, total, num_warps=1)
    ctx.save_for_backward(weights, middles, lengths, ray_starts)
    return total


def backward(ctx, d_total):
    weights, *rest = ctx.saved_tensors
    d_weights = empty(*weights.shape, device=weights.device)
    launch(_backward, (len(d_total),), d_total, weights, *rest, d_weights, num_warps=1)
    return d_weights, None, None, None


run = differentiable(forward, backward)
