"""Triton: a program takes some pixels with one plane and one view of each, and loops over their windows."""

import torch
import triton
import triton.language as tl

from .._gpu import blocks, launch
from .._operation import empty
from . import BEHIND_DEPTH, MIN_VARIANCE

E, MIN_DEPTH = tl.constexpr(MIN_VARIANCE), tl.constexpr(BEHIND_DEPTH)
BLOCK = tl.constexpr(128)


@triton.jit
def _pixel(picture, row, column, rows, columns, here):
    there = here & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    return tl.load(picture + row * columns + column, mask=there, other=0.0)


@triton.jit
def between(picture, row, column, down, right, rows, columns, here):
    """Bilinear interpolation between four pixels, zero outside."""
    above = (1 - right) * _pixel(picture, row, column, rows, columns, here)
    above += right * _pixel(picture, row, column + 1, rows, columns, here)
    below = (1 - right) * _pixel(picture, row + 1, column, rows, columns, here)
    below += right * _pixel(picture, row + 1, column + 1, rows, columns, here)
    return (1 - down) * above + down * below


@triton.jit
def _warp_coordinate(warp, row, x, y, h, here):
    """One homogeneous coordinate of the warp of (x, y) at inverse depth h; each pixel has its own warp."""
    at = warp + 4 * row
    along = tl.load(at, mask=here, other=0.0) * x + tl.load(at + 1, mask=here, other=0.0) * y
    return along + tl.load(at + 2, mask=here, other=0.0) + h * tl.load(at + 3, mask=here, other=0.0)


@triton.jit(do_not_specialize=["height", "width", "rows", "columns", "count", "planes", "views"])
def _costs(
    picture, trust, weights, weighted, warps, pixels, chosen, hypotheses, window, out,
    height, width, rows, columns, count, planes, views, sharpness, spread, SAMPLES: tl.constexpr,
):  # fmt: skip
    p = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    m, i = tl.program_id(1), tl.program_id(2)
    here = p < count
    pixel = tl.load(pixels + p, mask=here, other=0)
    row, column = pixel // width, pixel % width
    neighbour = tl.load(chosen + p * views + i, mask=here, other=0)
    warp = warps + 12 * neighbour
    weights += neighbour * rows * columns
    weighted += neighbour * rows * columns
    plane = hypotheses + 3 * (p * planes + m)
    h = tl.load(plane, mask=here, other=0.0)
    across, down = tl.load(plane + 1, mask=here, other=0.0), tl.load(plane + 2, mask=here, other=0.0)
    centre = tl.load(picture + pixel, mask=here, other=0.0)
    whole = tl.zeros([BLOCK], tl.float32)
    ones = tl.zeros([BLOCK], tl.float32)
    sum_a = tl.zeros([BLOCK], tl.float32)
    sum_b = tl.zeros([BLOCK], tl.float32)
    sum_aa = tl.zeros([BLOCK], tl.float32)
    sum_bb = tl.zeros([BLOCK], tl.float32)
    sum_ab = tl.zeros([BLOCK], tl.float32)
    for k in range(SAMPLES):
        dx, dy = tl.load(window + 2 * k), tl.load(window + 2 * k + 1)
        at_y, at_x = row + dy, column + dx
        inside = here & (at_y >= 0) & (at_y < height) & (at_x >= 0) & (at_x < width)
        a = tl.load(picture + at_y * width + at_x, mask=inside, other=0.0) - centre
        apart = (dx * dx + dy * dy).to(tl.float32) * spread
        w = tl.load(trust + at_y * width + at_x, mask=inside, other=0.0) * tl.exp(-a * a * sharpness - apart)
        whole += w
        x, y = at_x.to(tl.float32) + 0.5, at_y.to(tl.float32) + 0.5
        inverse_depth = h + across * dx.to(tl.float32) + down * dy.to(tl.float32)
        s = _warp_coordinate(warp, 2, x, y, inverse_depth, here)
        before = s > MIN_DEPTH
        inverse = 1 / tl.where(before, s, 1.0)
        u = _warp_coordinate(warp, 0, x, y, inverse_depth, here) * inverse - 0.5
        v = _warp_coordinate(warp, 1, x, y, inverse_depth, here) * inverse - 0.5
        u = tl.minimum(tl.maximum(u, -1.0), columns.to(tl.float32))
        v = tl.minimum(tl.maximum(v, -1.0), rows.to(tl.float32))
        left, top = tl.floor(u), tl.floor(v)
        c, r = left.to(tl.int32), top.to(tl.int32)
        seen = between(weights, r, c, v - top, u - left, rows, columns, inside & before)
        its = between(weighted, r, c, v - top, u - left, rows, columns, inside & before) - centre * seen  # W (b - a0)
        ones += w * seen
        sum_a += w * seen * a
        sum_b += w * its
        sum_aa += w * seen * a * a
        sum_bb += w * its * its / tl.maximum(seen, 1e-12)
        sum_ab += w * its * a
    inverse = 1 / tl.maximum(ones, 1e-12)
    mean_a, mean_b = sum_a * inverse, sum_b * inverse
    variance_a = tl.maximum(sum_aa * inverse - mean_a * mean_a, 0.0) + E
    variance_b = tl.maximum(sum_bb * inverse - mean_b * mean_b, 0.0) + E
    covariance = sum_ab * inverse - mean_a * mean_b
    cost = 1 - ones / tl.maximum(whole, 1e-12) * covariance / tl.sqrt(variance_a * variance_b)
    tl.store(out + (p * planes + m) * views + i, cost, mask=here)


def run(reference, trust, neighbours, neighbour_trust, warps, pixels, views, planes, window, deviation):
    (height, width), (rows, columns) = reference.shape, neighbours.shape[1:]
    count, depths, chosen = len(pixels), planes.shape[1], views.shape[1]
    out = empty(count, depths, chosen, device=reference.device)
    offsets = torch.tensor(window, dtype=torch.int32, device=reference.device)
    given = reference, trust, neighbour_trust, neighbour_trust * neighbours, warps, pixels, views, planes
    sizes = height, width, rows, columns, count, depths, chosen
    widths = 1 / (2 * deviation**2), 1 / (2 * (window[-1][1] + 1) ** 2)
    inputs = *(x.contiguous() for x in given), offsets, out, *sizes, *widths
    launch(_costs, (blocks(count, BLOCK), depths, chosen), *inputs, SAMPLES=len(window))
    return out
