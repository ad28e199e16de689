"""Numba. A row is one line of width x channels numbers, whose neighbouring pixels are `channels` numbers apart, so that
every inner loop runs along memory. A task goes down a strip of columns: it blurs one row along the line, keeps the last
eleven of these in cache, and blurs across them. The images' sum of squares is one quantity, since S depends only on
the sum of the variances.

A row's result does not depend on the tasks' sizes, so the total does not depend on the number of threads."""

import numpy as np
import torch
from numba import get_num_threads, njit, prange

from .._operation import differentiable, empty
from . import C1, C2, WINDOW, weights

REACH = WINDOW // 2
W0, W1, W2, W3, W4, W5 = (np.float32(w) for w in weights()[: REACH + 1])
K1, K2 = np.float32(C1), np.float32(C2)
ONE, TWO = np.float32(1), np.float32(2)
STRIP = 240  # numbers: eleven rows of four quantities, twice over, are 83 KiB; common widths are multiples of it
HEIGHT = 16  # rows a task takes at least, because it blurs ten more along the line
MEAN_A, SQUARES, PRODUCTS, MEAN_B = range(4)


@njit(inline="always")
def _window(x, at, step):
    """Weighted sum of eleven numbers, `step` apart."""
    total = W0 * (x[at] + x[at + 10 * step]) + W1 * (x[at + step] + x[at + 9 * step])
    total += W2 * (x[at + 2 * step] + x[at + 8 * step]) + W3 * (x[at + 3 * step] + x[at + 7 * step])
    return total + W4 * (x[at + 4 * step] + x[at + 6 * step]) + W5 * x[at + 5 * step]


@njit(fastmath=True, error_model="numpy")
def _moments(a, b, line, pixel):
    """Inputs of the blur: both images, their squares' sum, their product."""
    length = STRIP + 2 * REACH * len(pixel)
    for i in range(len(a)):
        line[i] = a[i]
        line[length + i] = b[i]
        line[2 * length + i] = a[i] * a[i] + b[i] * b[i]
        line[3 * length + i] = a[i] * b[i]


@njit(fastmath=True, error_model="numpy")
def _along(line, rows, pixel):
    length = STRIP + 2 * REACH * len(pixel)
    for x in range(STRIP):
        for q in range(4):
            blurred = _window(line, q * length + x, len(pixel))
            rows[q * STRIP + x] = blurred
            rows[(4 * WINDOW + q) * STRIP + x] = blurred


@njit(fastmath=True, error_model="numpy")
def _likeness(rows, out):
    """S and its derivatives in the mean of a, the squares' mean, the products' mean, and the mean of b."""
    for x in range(STRIP):
        a = _window(rows, x, 4 * STRIP)
        b = _window(rows, STRIP + x, 4 * STRIP)
        squares = _window(rows, 2 * STRIP + x, 4 * STRIP)
        products = _window(rows, 3 * STRIP + x, 4 * STRIP)
        ab, aabb = a * b, a * a + b * b
        A1, A2 = TWO * ab + K1, TWO * (products - ab) + K2
        B1, B2 = aabb + K1, squares - aabb + K2
        r = ONE / (B1 * B2)
        S = A1 * A2 * r
        p, q = TWO * (A2 - A1) * r, TWO * (B1 - B2) * S * r
        out[x] = S
        out[STRIP + x] = b * p + a * q
        out[2 * STRIP + x] = -S * B1 * r
        out[3 * STRIP + x] = TWO * A1 * r
        out[4 * STRIP + x] = a * p + b * q


@njit(fastmath=True, error_model="numpy")
def _sum(x):
    total = np.float32(0)
    for i in range(len(x)):
        total += x[i]
    return total


@njit(fastmath=True, error_model="numpy")
def _gap(a, b):
    total = np.float32(0)
    for i in range(len(a)):
        total += abs(a[i] - b[i])
    return total


@njit(parallel=True, fastmath=True, error_model="numpy", cache=True)
def _forward(a, b, pixel, bands, sums, gaps, maps):
    """Sums of S and of |a - b| by strip and row; with `maps`, also the derivatives of S, between margins of zeros."""
    height, width = a.shape
    margin = REACH * len(pixel)
    length = STRIP + 2 * margin
    strips = len(sums)
    for task in prange(bands * strips):
        band, strip = task // strips, task % strips
        top, bottom = height * band // bands, height * (band + 1) // bands
        left = strip * STRIP
        count = min(STRIP, width - left)
        first, last = max(left - margin, 0), min(left + STRIP + margin, width)
        line = np.zeros(4 * length, np.float32)
        inner = line[first - left + margin :]
        ring = np.empty(2 * WINDOW * 4 * STRIP, np.float32)
        out = np.empty(5 * STRIP, np.float32)
        for y in range(top - REACH, bottom + REACH):
            slot = (y - top + REACH) % WINDOW
            rows = ring[slot * 4 * STRIP :]
            if 0 <= y < height:
                _moments(a[y, first:last], b[y, first:last], inner, pixel)
                _along(line, rows, pixel)
            else:
                rows[: 4 * STRIP] = 0
                rows[WINDOW * 4 * STRIP : (WINDOW + 1) * 4 * STRIP] = 0
            middle = y - REACH
            if middle < top:
                continue
            _likeness(rows[4 * STRIP :], out)
            sums[strip, middle] = _sum(out[:count])
            gaps[strip, middle] = _gap(a[middle, left : left + count], b[middle, left : left + count])
            for q in range(maps.shape[1]):
                if strip == 0:
                    maps[middle, q, :margin] = 0
                at = margin + left
                maps[middle, q, at : at + count] = out[(q + 1) * STRIP : (q + 1) * STRIP + count]
                if strip == strips - 1:
                    maps[middle, q, at + count :] = 0


@njit(fastmath=True, error_model="numpy")
def _along_maps(mean, squares, products, rows, pixel):
    for x in range(STRIP):
        m = _window(mean, x, len(pixel))
        s = _window(squares, x, len(pixel))
        p = _window(products, x, len(pixel))
        rows[x] = m
        rows[STRIP + x] = s
        rows[2 * STRIP + x] = p
        rows[3 * WINDOW * STRIP + x] = m
        rows[(3 * WINDOW + 1) * STRIP + x] = s
        rows[(3 * WINDOW + 2) * STRIP + x] = p


@njit(fastmath=True, error_model="numpy")
def _gradient(rows, own, other, scale, step, out):
    for x in range(len(out)):
        mean = _window(rows, x, 3 * STRIP)
        squares = _window(rows, STRIP + x, 3 * STRIP)
        products = _window(rows, 2 * STRIP + x, 3 * STRIP)
        sign = np.float32(own[x] > other[x]) - np.float32(own[x] < other[x])
        out[x] = scale * (mean + TWO * own[x] * squares + other[x] * products) + step * sign


@njit(parallel=True, fastmath=True, error_model="numpy", cache=True)
def _backward(own, other, maps, mean, scale, step, pixel, bands, out):
    """Gradient of an image: the derivatives, blurred by the same window, since it is symmetric."""
    height, width = own.shape
    strips = (width + STRIP - 1) // STRIP
    for task in prange(bands * strips):
        band, strip = task // strips, task % strips
        top, bottom = height * band // bands, height * (band + 1) // bands
        left = strip * STRIP
        right = min(left + STRIP, width)
        ring = np.empty(2 * WINDOW * 3 * STRIP, np.float32)
        for y in range(top - REACH, bottom + REACH):
            slot = (y - top + REACH) % WINDOW
            rows = ring[slot * 3 * STRIP :]
            if 0 <= y < height:
                _along_maps(maps[y, mean, left:], maps[y, SQUARES, left:], maps[y, PRODUCTS, left:], rows, pixel)
            else:
                rows[: 3 * STRIP] = 0
                rows[WINDOW * 3 * STRIP : (WINDOW + 1) * 3 * STRIP] = 0
            middle = y - REACH
            if middle >= top:
                _gradient(
                    rows[3 * STRIP :],
                    own[middle, left:right],
                    other[middle, left:right],
                    scale,
                    step,
                    out[middle, left:right],
                )


def forward(ctx, a, b):
    height, width, channels = a.shape
    lines = [x.detach().reshape(height, -1).numpy() for x in (a, b)]
    wanted = ctx.needs_input_grad
    if wanted == (False, True):  # S is symmetric
        lines.reverse()
    strips = -(-width * channels // STRIP)
    maps = empty(height, 3 + all(wanted) if any(wanted) else 0, strips * STRIP + 2 * REACH * channels)
    ctx.pixel = (0,) * channels  # its length is known to the compiler, and how far apart pixels are
    ctx.bands = min(get_num_threads(), -(-height // HEIGHT))
    sums, gaps = np.empty((2, strips, height))
    _forward(*lines, ctx.pixel, ctx.bands, sums, gaps, maps.numpy())
    ctx.save_for_backward(a, b, maps)
    return tuple(torch.tensor(x.sum() / a.numel(), dtype=torch.float32) for x in (sums, gaps))


def backward(ctx, to_ssim, to_gap):
    a, b, maps = ctx.saved_tensors
    scale, step = (np.float32(grad.item() / a.numel()) for grad in (to_ssim, to_gap))
    gradients: list[torch.Tensor | None] = [None, None]
    for i, (own, other) in enumerate([(a, b), (b, a)]):
        if ctx.needs_input_grad[i]:
            found = gradients[i] = empty(*a.shape)
            lines = [x.detach().reshape(len(a), -1).numpy() for x in (own, other, found)]
            mean = MEAN_B if i and maps.shape[1] > MEAN_B else MEAN_A
            _backward(*lines[:2], maps.numpy(), mean, scale, step, ctx.pixel, ctx.bands, lines[2])
    return (*gradients,)


run = differentiable(forward, backward)
