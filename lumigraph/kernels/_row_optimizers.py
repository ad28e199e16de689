"""Triton: the steps of `LazyAdam` and `CloudAdam`, one launch for each table."""

import math

import triton
import triton.language as tl

from ._gpu import blocks, indices, launch

BLOCK = tl.constexpr(1024)  # elements
TILE = 2048  # elements of the rows that a program takes


@triton.jit(do_not_specialize=["count", "width"])
def _lazy(p, grad, mean, square, rates, count, width, rate, b1, b2, eps, keep, RATES: tl.constexpr):
    i, here = indices(count, BLOCK)
    g = tl.load(grad + i, mask=here, other=0.0)
    touched = g != 0
    if RATES:
        factor = tl.load(rates + i // width, mask=touched, other=0.0)
        touched = touched & (factor > 0)
        rate = rate * factor
    m = b1 * tl.load(mean + i, mask=touched, other=0.0) + (1 - b1) * g
    s = b2 * tl.load(square + i, mask=touched, other=0.0) + (1 - b2) * g * g
    value = keep * tl.load(p + i, mask=touched, other=0.0) - rate * m / (tl.sqrt(s) + eps)
    tl.store(mean + i, m, mask=touched)
    tl.store(square + i, s, mask=touched)
    tl.store(p + i, value, mask=touched)


def lazy_adam(p, grad, mean, square, rates, rate, b1, b2, eps, keep):
    """One step of `LazyAdam`, in place. rates: learning rates of rows, or None"""
    given = rates is not None
    tensors = p, grad.contiguous(), mean, square, rates if given else p
    numbers = p.numel(), math.prod(p.shape[1:]), rate, b1, b2, eps, keep
    launch(_lazy, (blocks(p.numel(), BLOCK),), *tensors, *numbers, RATES=given)


@triton.jit(do_not_specialize=["count", "width"])
def _cloud(
    p, grad, mean, square, last, columns, count, width, t, rate, b1, b2, log_b1, log_b2, eps,
    ROWS: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    row, column = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS), tl.arange(0, WIDTH)
    i = row[:, None] * width + column[None, :]
    g = tl.load(grad + i, mask=(row < count)[:, None] & (column < width)[None, :], other=0.0)
    seen = tl.max(tl.abs(g), axis=1) > 0
    touched = seen[:, None] & (column < width)[None, :]
    away = t - tl.load(last + row, mask=seen, other=0.0)
    kept1, kept2 = tl.exp2(away * log_b1), tl.exp2(away * log_b2)
    factors = tl.load(columns + column, mask=column < width, other=0.0)
    far = (rate * (1 - kept1) / (1 - b1))[:, None] * factors[None, :]
    m = kept1[:, None] * tl.load(mean + i, mask=touched, other=0.0) + (1 - b1) * g
    s = kept2[:, None] * tl.load(square + i, mask=touched, other=0.0) + (1 - b2) * g * g
    value = tl.load(p + i, mask=touched, other=0.0) - far * m / (tl.sqrt(s) + eps)
    tl.store(mean + i, m, mask=touched)
    tl.store(square + i, s, mask=touched)
    tl.store(p + i, value, mask=touched)
    tl.store(last + row, t + tl.zeros_like(away), mask=seen)


def cloud_adam(p, grad, mean, square, last, columns, t, rate, betas, eps):
    """One step of `CloudAdam`, in place. p, grad, mean, square: (row, column); columns: learning rate factors"""
    count, width = p.shape
    padded = triton.next_power_of_2(width)
    rows = max(TILE // padded, 1)
    launch(
        _cloud, (triton.cdiv(count, rows),), p, grad, mean, square, last, columns,
        count, width, t, rate, *betas, *map(math.log2, betas), eps, ROWS=rows, WIDTH=padded,
    )  # fmt: skip
