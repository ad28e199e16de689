"""Triton: a lane takes a pixel and its neighbour to the right or below. Changes and gradients meet in atomic adds."""

import torch
import triton
import triton.language as tl

from .._gpu import blocks, indices, launch, load_row
from .._operation import differentiable, empty
from ..rasterize_mesh.gpu import _add, _corners, _cross
from . import MAX_FACES as _MAX_FACES

MAX_FACES = tl.constexpr(_MAX_FACES)
PAIRS = tl.constexpr(64)  # of a program


@triton.jit
def _leaves(plane, sign, x, y, dx, dy):
    """Distance to the exit through a triangle's edge, as a fraction of (dx, dy); infinity for none."""
    slope = (plane[0] * dx + plane[1] * dy) * sign
    here = (plane[0] * x + plane[1] * y + plane[2]) * sign
    out = (slope < 0) & (here + slope < 0)
    return tl.where(out, here / tl.where(out, -slope, 1.0), float("inf"))


@triton.jit
def _chosen(k, first, second, third):
    return tl.where(k == 0, first, tl.where(k == 1, second, third))


@triton.jit
def _pairs(N, width, height):
    """Indices of pairs and of their first pixels, these pixels' columns and rows, the pairs' axes, and a mask."""
    n, here = indices(N, PAIRS)
    axis, pixel = n % 2, n // 2
    column, row = pixel % width, pixel // width
    return n, pixel, column, row, axis, here & (column + 1 - axis < width) & (row + axis < height)


@triton.jit
def _ends(edge, faces, here):
    """Vertices of an edge 3 f + k."""
    f, k = edge // 3, edge % 3
    i = tl.load(faces + 3 * f + (k + 1) % 3, mask=here, other=0).to(tl.int64)
    return i, tl.load(faces + 3 * f + (k + 2) % 3, mask=here, other=0).to(tl.int64)


@triton.jit
def _vertex(corners, v, axis, here):
    """Coordinates of a vertex along an axis and across it, and its depth."""
    z = tl.load(corners + 3 * v + 2, mask=here, other=1.0).to(tl.float64)
    along = tl.load(corners + 3 * v + axis, mask=here, other=0.0).to(tl.float64) / z
    return along, tl.load(corners + 3 * v + 1 - axis, mask=here, other=0.0).to(tl.float64) / z, z


@triton.jit
def _crossing(edge, column, row, axis, corners, faces, here):
    """Vertices of an edge and their positions, s, position along the edge in [0, 1], its slope, and whether it is steep
    enough to count."""
    i, j = _ends(edge, faces, here)
    a, c, z = _vertex(corners, i, axis, here)
    b, d, w = _vertex(corners, j, axis, here)
    counts = here & (tl.abs(a - b) <= tl.abs(c - d)) & (c != d)
    along, across = tl.where(axis == 0, column, row), tl.where(axis == 0, row, column)
    height = tl.where(counts, d - c, 1.0)
    share, slope = (across + 0.5 - c) / height, (b - a) / height
    s = a + share * (b - a) - along - 1.0
    return i, j, (a, c, z), (b, d, w), tl.minimum(tl.maximum(s, -0.5), 0.5), share, slope, counts


@triton.jit
def _follow(f, x, y, dx, dy, going, corners, faces, neighbours):
    """Silhouette edge 3 f + k at which each surface ends; -1 for none."""
    edge = tl.full([PAIRS], -1, tl.int64)
    step = 0
    while (step < MAX_FACES) & (tl.sum(going.to(tl.int32), 0) > 0):
        n, a, b, c = _corners(corners, faces, f, going)
        going = going & (tl.minimum(tl.minimum(a[2], b[2]), c[2]) > 0)
        first, second, third = _cross(b, c), _cross(c, a), _cross(a, b)
        volume = first[0] * a[0] + first[1] * a[1] + first[2] * a[2]
        sign = tl.where(volume < 0, -1.0, 1.0).to(tl.float64)
        p, q = _leaves(first, sign, x, y, dx, dy), _leaves(second, sign, x, y, dx, dy)
        r = _leaves(third, sign, x, y, dx, dy)
        least = tl.minimum(tl.minimum(p, q), r)
        going = going & (least < float("inf"))
        k = tl.where(least == p, 0, tl.where(least == q, 1, 2))
        beyond = tl.load(neighbours + 3 * f + k, mask=going, other=-1).to(tl.int64)
        i, j, m = load_row(faces, tl.maximum(beyond, 0), going & (beyond >= 0))
        v = tl.where(going & (beyond >= 0), i + j + m - n[0] - n[1] - n[2] + _chosen(k, n[0], n[1], n[2]), 0)
        hx, hy, hz = load_row(corners, v, going)
        plane = _chosen(k, first[0], second[0], third[0]), _chosen(k, first[1], second[1], third[1])
        side = (plane[0] * hx + plane[1] * hy + _chosen(k, first[2], second[2], third[2]) * hz) * sign
        ends = going & ((beyond < 0) | ((side > 0) & (hz > 0)))
        edge = tl.where(ends, 3 * f + k, edge)
        going = going & (ends == 0)
        f = tl.where(going, beyond, f)
        step += 1
    return edge


@triton.jit(do_not_specialize=["N", "width", "height"])
def _forward(
    picture, depth, found, corners, faces, neighbours, out, edges, N, width, height,
    C: tl.constexpr, CHANNELS: tl.constexpr,
):  # fmt: skip
    n, pixel, column, row, axis, here = _pairs(N, width, height)
    other = pixel + tl.where(axis == 0, 1, width)
    f = tl.load(found + pixel, mask=here, other=-1).to(tl.int64)
    g = tl.load(found + other, mask=here, other=-1).to(tl.int64)
    z, w = tl.load(depth + pixel, mask=here, other=0.0), tl.load(depth + other, mask=here, other=0.0)
    first = (g < 0) | ((f >= 0) & (z <= w))  # the nearer one
    turn = tl.where(first, 1, -1)
    dx, dy = tl.where(axis == 0, turn, 0).to(tl.float64), tl.where(axis == 0, 0, turn).to(tl.float64)
    x = tl.where(first | (axis == 1), column, column + 1).to(tl.float64) + 0.5
    y = tl.where(first | (axis == 0), row, row + 1).to(tl.float64) + 0.5
    edge = _follow(tl.where(first, f, g), x, y, dx, dy, here & (f != g), corners, faces, neighbours)
    there = edge >= 0
    _, _, _, _, s, _, _, counts = _crossing(tl.maximum(edge, 0), column, row, axis, corners, faces, there)
    tl.store(edges + n, tl.where(counts, edge, -1).to(tl.int32), mask=n < N)
    k = tl.arange(0, CHANNELS)[None, :]
    mask = counts[:, None] & (k < C)
    change = tl.load(picture + pixel[:, None] * C + k, mask=mask, other=0.0)
    change = s[:, None] * (change - tl.load(picture + other[:, None] * C + k, mask=mask, other=0.0))
    _add(out + tl.where(s > 0, other, pixel)[:, None] * C + k, change, mask)


@triton.jit
def _move(d_corners, v, place, g, slope, axis, here):
    """Gradient of a vertex h from that of its position: g along the axis, -g slope across it."""
    along, across, z = place
    _add(d_corners + 3 * v + axis, g / z, here)
    _add(d_corners + 3 * v + 1 - axis, -g * slope / z, here)
    _add(d_corners + 3 * v + 2, -g * (along - slope * across) / z, here)


@triton.jit(do_not_specialize=["N", "width", "height"])
def _backward(
    grad, picture, corners, faces, edges, d_picture, d_corners, N, width, height,
    C: tl.constexpr, CHANNELS: tl.constexpr,
):  # fmt: skip
    n, pixel, column, row, axis, here = _pairs(N, width, height)
    other = pixel + tl.where(axis == 0, 1, width)
    edge = tl.load(edges + n, mask=here, other=-1).to(tl.int64)
    there = edge >= 0
    i, j, a, b, s, share, slope, _ = _crossing(tl.maximum(edge, 0), column, row, axis, corners, faces, there)
    k = tl.arange(0, CHANNELS)[None, :]
    mask = there[:, None] & (k < C)
    g = tl.load(grad + tl.where(s > 0, other, pixel)[:, None] * C + k, mask=mask, other=0.0)
    change = tl.load(picture + pixel[:, None] * C + k, mask=mask, other=0.0)
    change -= tl.load(picture + other[:, None] * C + k, mask=mask, other=0.0)
    _add(d_picture + pixel[:, None] * C + k, s[:, None] * g, mask)
    _add(d_picture + other[:, None] * C + k, -s[:, None] * g, mask)
    to_s = tl.sum(g * change, 1)
    _move(d_corners, i, a, to_s * (1 - share), slope, axis, there)
    _move(d_corners, j, b, to_s * share, slope, axis, there)


def forward(ctx, picture, depth, found, corners, faces, neighbours):
    height, width, channels = picture.shape
    ctx.sizes = {"N": 2 * height * width, "width": width, "height": height}
    ctx.sizes |= {"C": channels, "CHANNELS": triton.next_power_of_2(channels)}
    out, edges = picture.clone(), empty(height, width, 2, dtype=torch.int32, device=picture.device)
    ctx.grid = (blocks(2 * height * width, PAIRS) if len(faces) else 0,)
    launch(_forward, ctx.grid, picture, depth, found, corners, faces, neighbours, out, edges, **ctx.sizes)
    ctx.save_for_backward(picture, corners, faces, edges)
    return out


def backward(ctx, grad):
    saved = ctx.saved_tensors
    results = grad.clone(), torch.zeros_like(saved[1])
    launch(_backward, ctx.grid, grad, *saved, *results, **ctx.sizes)
    return results[0], None, None, results[1], None, None


run = differentiable(forward, backward)
