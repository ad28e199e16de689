"""Triton: a program follows one path, a lane a disparity; then a program takes a pixel."""

import torch
import triton
import triton.language as tl

from .._gpu import launch
from .._operation import empty
from . import NO_RIVAL, PATHS

NOTHING, FAR = tl.constexpr(NO_RIVAL), tl.constexpr(1 << 20)


@triton.jit(do_not_specialize=["height", "width", "count", "slope"])
def _path(
    costs, guide, penalties, total, line, height, width, count, slope, DX: tl.constexpr, DY: tl.constexpr,
    LANES: tl.constexpr,
):  # fmt: skip
    """Aggregate along paths. line: buffer of each path's L, padded at both ends by values that are never least. A path
    that leaves the picture sideways goes on at the other side as a new one."""
    number, k = tl.program_id(0), tl.arange(0, LANES)
    here = k < count
    line += number * (count + 2) + 1
    L = tl.full([LANES], FAR, tl.int32)
    before = number * 0
    steps = width if DY == 0 else height
    for step in range(steps):
        if DY == 0:
            y, x = number, (step if DX > 0 else width - 1 - step)
            begins = step == 0
        else:
            y, x = (step if DY > 0 else height - 1 - step), (number + (step + 1) * DX) % width
            x = tl.where(x < 0, x + width, x)
            begins = (step == 0) | (x - DX < 0) | (x - DX >= width)
        pixel = y * width + x
        tl.store(line + k, L, mask=here)
        tl.debug_barrier()
        beside = tl.minimum(tl.load(line + k - 1, mask=here, other=FAR), tl.load(line + k + 1, mask=here, other=FAR))
        tl.debug_barrier()
        own = tl.load(guide + pixel).to(tl.int32)
        difference = tl.abs(own - tl.load(guide + tl.where(begins, pixel, before)).to(tl.int32))
        jump = tl.load(penalties + difference).to(tl.int32)
        least = tl.min(L, 0)
        C = tl.load(costs + pixel.to(tl.int64) * count + k, mask=here, other=0).to(tl.int32)
        reached = C - least + tl.minimum(tl.minimum(L, beside + slope), least + jump)
        L = tl.where(here, tl.where(begins, C, reached), FAR)
        at = total + pixel.to(tl.int64) * count + k
        tl.store(at, tl.load(at, mask=here, other=0) + L, mask=here)
        before = pixel


@triton.jit(do_not_specialize=["width", "count", "first"])
def _winners(total, left, right, margin, width, count, first, LANES: tl.constexpr):
    pixel, k = tl.program_id(0).to(tl.int64), tl.arange(0, LANES)
    here = k < count
    S = tl.load(total + pixel * count + k, mask=here, other=FAR)
    least = tl.min(S, 0)
    best = tl.min(tl.where(S == least, k, LANES), 0)
    inner = (best > 0) & (best < count - 1)
    a = tl.load(total + pixel * count + best - 1, mask=inner, other=0).to(tl.float32)
    b = tl.load(total + pixel * count + best + 1, mask=inner, other=0).to(tl.float32)
    slope = 2 * (tl.maximum(a, b) - least)
    moved = tl.where(inner & (slope > 0), (a - b) / tl.where(slope > 0, slope, 1.0), 0.0)
    tl.store(left + pixel, first + best + moved)
    rivals = tl.where(here & (tl.abs(k - best) > 1), S, NOTHING)
    tl.store(margin + pixel, (tl.min(rivals, 0) - least).to(tl.float32))
    x = pixel % width + first + k  # of the left pixel that this one of the right meets
    inside = here & (x >= 0) & (x < width)
    met = tl.load(total + (pixel - pixel % width + x) * count + k, mask=inside, other=FAR)
    lowest = tl.min(met, 0)
    best = tl.min(tl.where(inside & (met == lowest), k, LANES), 0)
    tl.store(right + pixel, (first + tl.where(lowest < FAR, best, -1)).to(tl.float32))


def run(costs, guide, penalties, slope_penalty, first):
    height, width, count = costs.shape
    costs, guide, penalties = (x.contiguous() for x in (costs, guide, penalties))
    total = torch.zeros(height, width, count, dtype=torch.int32, device=costs.device)
    line = torch.full((max(height, width), count + 2), FAR.value, dtype=torch.int32, device=costs.device)
    lanes = triton.next_power_of_2(count)
    given = costs, guide, penalties, total, line, height, width, count, slope_penalty
    for dx, dy in PATHS if costs.numel() else ():
        launch(_path, (height if dy == 0 else width,), *given, DX=dx, DY=dy, LANES=lanes)
    left, right, margin = (empty(height, width, device=costs.device) for _ in range(3))
    launch(_winners, (height * width,), total, left, right, margin, width, count, first, LANES=lanes)
    return left, right, margin
