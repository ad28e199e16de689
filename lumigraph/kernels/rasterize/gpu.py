"""Triton: one program takes a square of up to 16 x 16 pixels of a tile, and its list a few Gaussians at a time.

Backward goes the same way again, and sums over a program's pixels meet in atomic adds. With g_i the derivative of the
loss in w_i, dL/da_i = T_i g_i - sum_{j>i} w_j g_j / (1 - a_i), where the sum over all j is known from the outputs.
"""

import torch
import triton
import triton.language as tl

from .._gpu import launch, load_row, store_row
from .._operation import differentiable, empty
from ..project import MAX_ALPHA as _MAX_ALPHA
from ..project import MIN_ALPHA as _MIN_ALPHA

MIN_ALPHA, MAX_ALPHA = tl.constexpr(_MIN_ALPHA), tl.constexpr(_MAX_ALPHA)
SQUARE = 16  # pixels along a program's share of a tile, at most
MIN_TRANSMITTANCE = 1e-37  # less light is none, and a program without any has ended
GAUSSIANS = tl.constexpr(
    8
)  # looked at together; a matrix with a row for each and a column for each pixel must fit into registers


@triton.jit
def _pixels(width, height, SIDE: tl.constexpr, SQUARE: tl.constexpr):
    """Tile, centres and indices of the program's pixels, and a mask of those inside the picture."""
    shares: tl.constexpr = (SIDE // SQUARE) * (SIDE // SQUARE)
    k, share = tl.program_id(0) // shares, tl.program_id(0) % shares
    across = (width + SIDE - 1) // SIDE
    pixel = tl.arange(0, SQUARE * SQUARE)
    x = k % across * SIDE + share % (SIDE // SQUARE) * SQUARE + pixel % SQUARE
    y = k // across * SIDE + share // (SIDE // SQUARE) * SQUARE + pixel // SQUARE
    return k, x + 0.5, y + 0.5, y.to(tl.int64) * width + x, (x < width) & (y < height)


@triton.jit
def _gaussians(i, here, order, gaussians):
    """Numbers, centres, conics, opacities and values of the tile's Gaussians at i; opacity 0 after the last."""
    centres, conics, opacities, colours, depths = gaussians
    n = tl.load(order + i, mask=here, other=0).to(tl.int64)
    cx, cy = tl.load(centres + 2 * n, mask=here, other=0.0), tl.load(centres + 2 * n + 1, mask=here, other=0.0)
    a, b, c = load_row(conics, n, here)
    red, green, blue = load_row(colours, n, here)
    opacity, depth = tl.load(opacities + n, mask=here, other=0.0), tl.load(depths + n, mask=here, other=0.0)
    return n, (cx, cy), (a, b, c), opacity, (red, green, blue, depth)


@triton.jit
def _steady(conic):
    """q as a sum of squares, a (dx + b/a dy)^2 + (c - b^2/a) dy^2, which avoids cancellation along thin ellipses."""
    a, b, c = conic
    a = tl.maximum(a, 1e-30)
    square = b * b
    det = tl.fma(a, c, -square) - tl.fma(b, b, -square)
    return a, b / a, det / a


@triton.jit
def _light(dx, dy, conic, opacity, transmittance, stop, EXCLUSIVE: tl.constexpr):
    """Gaussian by pixel: opacity before and after thresholds, transmittance T before and behind each, and weight w."""
    a, tilt, rest = _steady(conic)
    t = tl.fma(tilt[:, None], dy, dx)
    raw = opacity[:, None] * tl.exp(-0.5 * (a[:, None] * t * t + rest[:, None] * dy * dy))
    alpha = tl.where(raw < MIN_ALPHA, 0.0, tl.minimum(raw, MAX_ALPHA))
    T_next = transmittance[None, :] * tl.cumprod(1 - alpha, 0)
    T = T_next / (1 - alpha)
    ended = T_next <= stop if EXCLUSIVE else T < stop
    return raw, alpha, T, T_next, tl.where(ended, 0.0, alpha * T), ended


@triton.jit
def _of_pixel(outputs, at, inside):
    """Outputs, or their gradients, of each pixel."""
    picture, depth, weight = outputs
    red, green, blue = load_row(picture, at, inside)
    return red, green, blue, tl.load(depth + at, mask=inside, other=0.0), tl.load(weight + at, mask=inside, other=0.0)


@triton.jit(do_not_specialize=["width", "height"])
def _forward(
    gaussians, order, starts, outputs, width, height, stop, SIDE: tl.constexpr, SQUARE: tl.constexpr,
    EXCLUSIVE: tl.constexpr
):  # fmt: skip
    picture, depth, weight = outputs
    k, x, y, at, inside = _pixels(width, height, SIDE, SQUARE)
    first, last = tl.load(starts + k), tl.load(starts + k + 1)
    transmittance = tl.where(inside, 1.0, 0.0)
    red, green, blue = tl.zeros_like(transmittance), tl.zeros_like(transmittance), tl.zeros_like(transmittance)
    sum_depth, sum_w = tl.zeros_like(transmittance), tl.zeros_like(transmittance)
    while (first < last) & (tl.max(transmittance, 0) >= stop):
        i = first + tl.arange(0, GAUSSIANS)
        _, centre, conic, opacity, v = _gaussians(i, i < last, order, gaussians)
        dx, dy = x[None, :] - centre[0][:, None], y[None, :] - centre[1][:, None]
        _, _, _, T_next, w, _ = _light(dx, dy, conic, opacity, transmittance, stop, EXCLUSIVE)
        red += tl.sum(w * v[0][:, None], 0)
        green += tl.sum(w * v[1][:, None], 0)
        blue += tl.sum(w * v[2][:, None], 0)
        sum_depth += tl.sum(w * v[3][:, None], 0)
        sum_w += tl.sum(w, 0)
        transmittance = tl.min(T_next, 0)  # it only ever grows darker
        first += GAUSSIANS
    store_row(picture, at, (red, green, blue), inside)
    tl.store(depth + at, sum_depth, mask=inside)
    tl.store(weight + at, sum_w, mask=inside)


@triton.jit
def _add(pointer, n, value, here):
    """Atomic add that skips zeros, which are most where a Gaussian is small."""
    tl.atomic_add(pointer + n, value, mask=here & (value != 0), sem="relaxed")


@triton.jit(do_not_specialize=["width", "height"])
def _backward(
    grads, gaussians, order, starts, outputs, found, spread, width, height, stop, SIDE: tl.constexpr,
    SQUARE: tl.constexpr, EXCLUSIVE: tl.constexpr, SPREADS: tl.constexpr
):  # fmt: skip
    d_centres, d_conics, d_opacities, d_colours, d_depths = found
    k, x, y, at, inside = _pixels(width, height, SIDE, SQUARE)
    first, last = tl.load(starts + k), tl.load(starts + k + 1)
    transmittance = tl.where(inside, 1.0, 0.0)
    g = _of_pixel(grads, at, inside)
    seen = _of_pixel(outputs, at, inside)
    rest = g[0] * seen[0] + g[1] * seen[1] + g[2] * seen[2] + g[3] * seen[3] + g[4] * seen[4]  # sum of w_j g_j to come
    while (first < last) & (tl.max(transmittance, 0) >= stop):
        i = first + tl.arange(0, GAUSSIANS)
        here = i < last
        n, centre, conic, opacity, v = _gaussians(i, here, order, gaussians)
        dx, dy = x[None, :] - centre[0][:, None], y[None, :] - centre[1][:, None]
        raw, alpha, T, T_next, w, ended = _light(dx, dy, conic, opacity, transmittance, stop, EXCLUSIVE)
        g_w = v[0][:, None] * g[0][None, :] + v[1][:, None] * g[1][None, :] + v[2][:, None] * g[2][None, :]
        g_w += v[3][:, None] * g[3][None, :] + g[4][None, :]
        gw_behind = rest[None, :] - tl.cumsum(w * g_w, 0)
        moves = (raw >= MIN_ALPHA) & (raw <= MAX_ALPHA) & (ended == 0)
        d_power = tl.where(moves, raw * (T * g_w - gw_behind / (1 - alpha)), 0.0)
        _add(d_colours, 3 * n, tl.sum(w * g[0][None, :], 1), here)
        _add(d_colours, 3 * n + 1, tl.sum(w * g[1][None, :], 1), here)
        _add(d_colours, 3 * n + 2, tl.sum(w * g[2][None, :], 1), here)
        _add(d_depths, n, tl.sum(w * g[3][None, :], 1), here)
        _add(d_opacities, n, tl.sum(d_power, 1) / tl.where(opacity > 0, opacity, 1.0), here)
        sum_x, sum_y = tl.sum(d_power * dx, 1), tl.sum(d_power * dy, 1)
        _add(d_centres, 2 * n, conic[0] * sum_x + conic[1] * sum_y, here)
        _add(d_centres, 2 * n + 1, conic[1] * sum_x + conic[2] * sum_y, here)
        if SPREADS:
            to_x = tl.abs(d_power * (conic[0][:, None] * dx + conic[1][:, None] * dy))
            to_y = tl.abs(d_power * (conic[1][:, None] * dx + conic[2][:, None] * dy))
            _add(spread, 2 * n, tl.sum(to_x, 1), here)
            _add(spread, 2 * n + 1, tl.sum(to_y, 1), here)
        _add(d_conics, 3 * n, -0.5 * tl.sum(d_power * dx * dx, 1), here)
        _add(d_conics, 3 * n + 1, -tl.sum(d_power * dx * dy, 1), here)
        _add(d_conics, 3 * n + 2, -0.5 * tl.sum(d_power * dy * dy, 1), here)
        rest -= tl.sum(w * g_w, 0)
        transmittance = tl.min(T_next, 0)
        first += GAUSSIANS


def forward(ctx, centres, conics, opacities, colours, depths, tiles, stop, exclusive=False, spread=None):
    (width, height), device = tiles.size, centres.device
    gaussians = centres, conics, opacities, colours, depths
    outputs = tuple(empty(*shape, device=device) for shape in ((height, width, 3), (height, width), (height, width)))
    square = min(tiles.side, SQUARE)
    ctx.grid = (tiles.across * tiles.down * (tiles.side // square) ** 2,)
    ctx.rest = width, height, max(float(stop), MIN_TRANSMITTANCE)
    ctx.options, ctx.spread = {"SIDE": tiles.side, "SQUARE": square, "EXCLUSIVE": exclusive}, spread
    launch(_forward, ctx.grid, gaussians, tiles.order, tiles.starts, outputs, *ctx.rest, **ctx.options)
    ctx.save_for_backward(*gaussians, tiles.order, tiles.starts, *outputs)
    return outputs


def backward(ctx, *grads):
    *gaussians, order, starts, picture, depth, weight = ctx.saved_tensors
    found = tuple(torch.zeros_like(x) for x in gaussians)
    given = grads, tuple(gaussians), order, starts, (picture, depth, weight), found
    spread = found[0] if ctx.spread is None else ctx.spread  # the former is not written to
    launch(_backward, ctx.grid, *given, spread, *ctx.rest, **ctx.options, SPREADS=ctx.spread is not None)
    return *found, None, None, None, None


run = differentiable(forward, backward)
