"""Triton: a program takes some pixels at one plane and one neighbour, and loops over their windows."""

import triton
import triton.language as tl

from .._gpu import blocks, launch
from .._operation import empty
from ..patch_cost.gpu import between
from . import BEHIND_DEPTH, MIN_VARIANCE

E, MIN_DEPTH = tl.constexpr(MIN_VARIANCE), tl.constexpr(BEHIND_DEPTH)
BLOCK = tl.constexpr(128)


@triton.jit(do_not_specialize=["height", "width", "rows", "columns", "planes"])
def _costs(
    picture, trust, weights, weighted, warps, hypotheses, out, height, width, rows, columns, planes,
    WINDOW: tl.constexpr,
):  # fmt: skip
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    plane, neighbour = tl.program_id(1), tl.program_id(2).to(tl.int64)
    here = pixel < height * width
    h, warp = tl.load(hypotheses + plane), warps + 12 * neighbour
    weights += neighbour * rows * columns
    weighted += neighbour * rows * columns
    n = tl.zeros([BLOCK], tl.float32)
    sum_a = tl.zeros([BLOCK], tl.float32)
    sum_b = tl.zeros([BLOCK], tl.float32)
    sum_aa = tl.zeros([BLOCK], tl.float32)
    sum_bb = tl.zeros([BLOCK], tl.float32)
    sum_ab = tl.zeros([BLOCK], tl.float32)
    for k in range(WINDOW * WINDOW):
        y = pixel // width + k // WINDOW - WINDOW // 2
        x = pixel % width + k % WINDOW - WINDOW // 2
        inside = here & (y >= 0) & (y < height) & (x >= 0) & (x < width)
        a = tl.load(picture + y * width + x, mask=inside, other=0.0)
        t = tl.load(trust + y * width + x, mask=inside, other=0.0)
        centre_x, centre_y = x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5
        u = tl.load(warp) * centre_x + tl.load(warp + 1) * centre_y + tl.load(warp + 2) + h * tl.load(warp + 3)
        v = tl.load(warp + 4) * centre_x + tl.load(warp + 5) * centre_y + tl.load(warp + 6) + h * tl.load(warp + 7)
        s = tl.load(warp + 8) * centre_x + tl.load(warp + 9) * centre_y + tl.load(warp + 10) + h * tl.load(warp + 11)
        before = s > MIN_DEPTH
        inverse = 1 / tl.where(before, s, 1.0)
        u = tl.minimum(tl.maximum(u * inverse - 0.5, -1.0), columns.to(tl.float32))
        v = tl.minimum(tl.maximum(v * inverse - 0.5, -1.0), rows.to(tl.float32))
        column, row = tl.floor(u), tl.floor(v)
        right, down = u - column, v - row
        c, r = column.to(tl.int32), row.to(tl.int32)
        seen = between(weights, r, c, down, right, rows, columns, inside & before)
        its = between(weighted, r, c, down, right, rows, columns, inside & before)  # W b
        n += t * seen
        sum_a += t * seen * a
        sum_b += t * its
        sum_aa += t * seen * a * a
        sum_bb += t * its * its / tl.maximum(seen, 1e-12)
        sum_ab += t * its * a
    inverse = 1 / tl.maximum(n, 1e-12)
    mean_a, mean_b = sum_a * inverse, sum_b * inverse
    variance_a = tl.maximum(sum_aa * inverse - mean_a * mean_a, 0.0) + E
    variance_b = tl.maximum(sum_bb * inverse - mean_b * mean_b, 0.0) + E
    covariance = sum_ab * inverse - mean_a * mean_b
    cost = 1 - n / (WINDOW * WINDOW) * covariance / tl.sqrt(variance_a * variance_b)
    place = (neighbour * planes + plane) * height * width + pixel
    tl.store(out + place, cost, mask=here)


def run(reference, trust, neighbours, neighbour_trust, warps, hypotheses, window, best):
    (height, width), (count, rows, columns), planes = reference.shape, neighbours.shape, len(hypotheses)
    costs = empty(count, planes, height, width, device=reference.device)
    given = reference, trust, neighbour_trust, neighbour_trust * neighbours, warps, hypotheses
    inputs = *(x.contiguous() for x in given), costs, height, width, rows, columns, planes
    launch(_costs, (blocks(height * width, BLOCK), planes, count), *inputs, WINDOW=window)
    return costs.topk(best, 0, largest=False).values.mean(0)
