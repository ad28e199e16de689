"""Triton: a row is one line of width x channels numbers. One pass blurs along the line, another across the lines."""

from functools import cache

import torch
import triton
import triton.language as tl
from torch import Tensor

from .._gpu import blocks, launch
from .._operation import differentiable, empty
from . import C1, C2, WINDOW, weights

TAPS, REACH = tl.constexpr(WINDOW), tl.constexpr(WINDOW // 2)
K1, K2 = tl.constexpr(C1), tl.constexpr(C2)
BLOCK = tl.constexpr(256)
MEAN_A, MEAN_B = 0, 3  # of the maps


@triton.jit
def _place(length):
    """This program's row, its indices along it, and their mask."""
    x = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    return tl.program_id(0).to(tl.int64), x, x < length


@triton.jit
def _across(plane, window, x, y, size, length, here):
    """Blur across the lines, of rows that are blurred along."""
    total = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(TAPS):
        at = (y + (k - REACH)) * length + x
        there = here & (at >= 0) & (at < size)
        total += tl.load(window + k) * tl.load(plane + at, mask=there, other=0.0)
    return total


@triton.jit(do_not_specialize=["height", "length"])
def _moments(a, b, window, rows, height, length, C: tl.constexpr):
    """Blur along the lines: both images, their squares' sum, their product."""
    y, x, here = _place(length)
    mean_a = tl.zeros([BLOCK], tl.float32)
    mean_b = tl.zeros([BLOCK], tl.float32)
    squares = tl.zeros([BLOCK], tl.float32)
    products = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(TAPS):
        at = x + (k - REACH) * C
        there = (at >= 0) & (at < length)
        w = tl.load(window + k)
        value_a = tl.load(a + y * length + at, mask=there, other=0.0)
        value_b = tl.load(b + y * length + at, mask=there, other=0.0)
        mean_a += w * value_a
        mean_b += w * value_b
        squares += w * (value_a * value_a + value_b * value_b)
        products += w * value_a * value_b
    place, size = rows + y * length + x, height.to(tl.int64) * length
    tl.store(place, mean_a, mask=here)
    tl.store(place + size, mean_b, mask=here)
    tl.store(place + 2 * size, squares, mask=here)
    tl.store(place + 3 * size, products, mask=here)


@triton.jit(do_not_specialize=["height", "length"])
def _likeness(first, second, rows, window, out, maps, height, length, MAPS: tl.constexpr):
    """S, |a - b|, and the derivatives of S in the mean of a, the squares' mean, the products' mean, the mean of b."""
    y, x, here = _place(length)
    size = height.to(tl.int64) * length
    a = _across(rows, window, x, y, size, length, here)
    b = _across(rows + size, window, x, y, size, length, here)
    squares = _across(rows + 2 * size, window, x, y, size, length, here)
    products = _across(rows + 3 * size, window, x, y, size, length, here)
    A1, A2 = 2 * a * b + K1, 2 * (products - a * b) + K2
    B1, B2 = a * a + b * b + K1, squares - (a * a + b * b) + K2
    S = A1 * A2 / (B1 * B2)
    at = y * length + x
    gap = tl.load(first + at, mask=here, other=0.0) - tl.load(second + at, mask=here, other=0.0)
    tl.store(out + at, S, mask=here)
    tl.store(out + size + at, tl.abs(gap), mask=here)
    place = maps + y * length + x
    p, q = 2 * (A2 - A1) / (B1 * B2), 2 * S * (B1 - B2) / (B1 * B2)
    if MAPS:
        tl.store(place, b * p + a * q, mask=here)
        tl.store(place + size, -S / B2, mask=here)
        tl.store(place + 2 * size, 2 * A1 / (B1 * B2), mask=here)
    if MAPS == 4:
        tl.store(place + 3 * size, a * p + b * q, mask=here)


@triton.jit(do_not_specialize=["height", "length"])
def _along(maps, window, rows, height, length, C: tl.constexpr):
    y, x, here = _place(length)
    start = (tl.program_id(2) * height.to(tl.int64) + y) * length
    total = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(TAPS):
        at = x + (k - REACH) * C
        there = (at >= 0) & (at < length)
        total += tl.load(window + k) * tl.load(maps + start + at, mask=there, other=0.0)
    tl.store(rows + start + x, total, mask=here)


@triton.jit(do_not_specialize=["height", "length", "mean"])
def _gradient(rows, window, own, other, to_ssim, to_gap, d_own, height, length, mean, share):
    """Gradient of an image: the derivatives, blurred by the same window, since it is symmetric."""
    y, x, here = _place(length)
    size = height.to(tl.int64) * length
    to_mean = _across(rows + mean * size, window, x, y, size, length, here)
    to_squares = _across(rows + size, window, x, y, size, length, here)
    to_products = _across(rows + 2 * size, window, x, y, size, length, here)
    place = y * length + x
    mine, its = tl.load(own + place, mask=here), tl.load(other + place, mask=here)
    to_own = to_mean + 2 * mine * to_squares + its * to_products
    sign = tl.where(mine > its, 1.0, 0.0) - tl.where(mine < its, 1.0, 0.0)
    tl.store(d_own + place, share * (tl.load(to_ssim) * to_own + tl.load(to_gap) * sign), mask=here)


@cache
def _window(device: torch.device) -> Tensor:
    return torch.tensor(weights(), dtype=torch.float32, device=device)


def forward(ctx, a, b):
    height, width, channels = a.shape
    length = width * channels
    ctx.grid, ctx.window = (height, blocks(length, BLOCK)), _window(a.device)
    wanted = ctx.needs_input_grad
    first, second = (b, a) if wanted == (False, True) else (a, b)  # S is symmetric
    count = 3 + all(wanted) if any(wanted) else 0
    rows, out, maps = (empty(n, height, length, device=a.device) for n in (4, 2, count))
    launch(_moments, ctx.grid, first, second, ctx.window, rows, height, length, C=channels)
    launch(_likeness, ctx.grid, first, second, rows, ctx.window, out, maps, height, length, MAPS=count)
    ctx.save_for_backward(a, b, maps)
    return out[0].mean(), out[1].mean()


def backward(ctx, *grads):
    a, b, maps = ctx.saved_tensors
    count, height, length = maps.shape
    rows = empty(*maps.shape, device=a.device)
    launch(_along, (*ctx.grid, count), maps, ctx.window, rows, height, length, C=a.shape[2])
    gradients: list[Tensor | None] = [None, None]
    for i, (own, other) in enumerate([(a, b), (b, a)]):
        if ctx.needs_input_grad[i]:
            mean = MEAN_B if i and count > MEAN_B else MEAN_A
            found = gradients[i] = empty(*a.shape, device=a.device)
            given = rows, ctx.window, own, other, *grads, found
            launch(_gradient, ctx.grid, *given, height, length, mean, 1 / a.numel())
    return (*gradients,)


run = differentiable(forward, backward)
