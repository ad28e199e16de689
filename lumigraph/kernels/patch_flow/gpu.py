"""Triton: a program takes one patch, a lane one of its pixels."""

import triton
import triton.language as tl

from .._gpu import launch
from .._operation import empty
from . import MIN_GRADIENT

E = tl.constexpr(MIN_GRADIENT)


@triton.jit
def _value(picture, x, y, height, width, here):
    x = tl.minimum(tl.maximum(x, 0.0), (width - 1).to(tl.float32))
    y = tl.minimum(tl.maximum(y, 0.0), (height - 1).to(tl.float32))
    left, top = tl.floor(x).to(tl.int32), tl.floor(y).to(tl.int32)
    right, below = tl.minimum(left + 1, width - 1), tl.minimum(top + 1, height - 1)
    fx, fy = x - left, y - top
    above = (1 - fx) * tl.load(picture + top * width + left, mask=here, other=0.0)
    above += fx * tl.load(picture + top * width + right, mask=here, other=0.0)
    under = (1 - fx) * tl.load(picture + below * width + left, mask=here, other=0.0)
    under += fx * tl.load(picture + below * width + right, mask=here, other=0.0)
    return (1 - fy) * above + fy * under


@triton.jit(do_not_specialize=["height", "width", "columns", "size", "stride", "iterations"])
def _flow(
    start, first, second, gradient, out, height, width, columns, size, stride, iterations, LANES: tl.constexpr
):  # fmt: skip
    patch, k = tl.program_id(0), tl.arange(0, LANES)
    here = k < size * size
    y, x = patch // columns * stride + k // size, patch % columns * stride + k % size
    at = tl.minimum(y, height - 1) * width + tl.minimum(x, width - 1)
    T = tl.load(first + at, mask=here, other=0.0)
    gx, gy = tl.load(gradient + 2 * at, mask=here, other=0.0), tl.load(gradient + 2 * at + 1, mask=here, other=0.0)
    count = (size * size).to(tl.float32)
    gx = tl.where(here, gx - tl.sum(gx, 0) / count, 0.0)
    gy = tl.where(here, gy - tl.sum(gy, 0) / count, 0.0)
    xx, xy, yy = tl.sum(gx * gx, 0) + E, tl.sum(gx * gy, 0), tl.sum(gy * gy, 0) + E
    inverse = 1 / (xx * yy - xy * xy)
    begin_u, begin_v = tl.load(start + 2 * patch), tl.load(start + 2 * patch + 1)
    u, v = begin_u, begin_v
    for _ in range(iterations):
        off = _value(second, x.to(tl.float32) + u, y.to(tl.float32) + v, height, width, here) - T
        of_x, of_y = tl.sum(gx * off, 0), tl.sum(gy * off, 0)
        u -= (yy * of_x - xy * of_y) * inverse
        v -= (xx * of_y - xy * of_x) * inverse
    far = (u - begin_u) * (u - begin_u) + (v - begin_v) * (v - begin_v) > count
    tl.store(out + 2 * patch, tl.where(far, begin_u, u))
    tl.store(out + 2 * patch + 1, tl.where(far, begin_v, v))


def run(start, first, second, gradient, size, stride, iterations):
    rows, columns = start.shape[:2]
    out = empty(*start.shape, device=start.device)
    given = (x.contiguous() for x in (start, first, second, gradient))
    sizes = *first.shape, columns, size, stride, iterations
    launch(_flow, (rows * columns,), *given, out, *sizes, LANES=triton.next_power_of_2(size * size))
    return out
