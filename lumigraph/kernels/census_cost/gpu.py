"""Triton: signatures of all pixels, then the cost of each pixel and disparity."""

import torch
import triton
import triton.language as tl

from .._gpu import blocks, indices, launch
from .._operation import empty
from . import DIFFERENCE_SHIFT, MAX_DIFFERENCE, OFFSETS, UNSEEN_COST

SHIFT, CAP, UNSEEN = (tl.constexpr(n) for n in (DIFFERENCE_SHIFT, MAX_DIFFERENCE, UNSEEN_COST))
BLOCK = tl.constexpr(256)


@triton.jit(do_not_specialize=["height", "width"])
def _signatures(picture, offsets, out, height, width, OFFSETS: tl.constexpr):
    i, here = indices(height * width, BLOCK)
    row, column = i // width, i % width
    centre = tl.load(picture + i, mask=here, other=0)
    code = tl.zeros([BLOCK], tl.int32)
    for k in range(OFFSETS):
        x = tl.minimum(tl.maximum(column + tl.load(offsets + 2 * k), 0), width - 1)
        y = tl.minimum(tl.maximum(row + tl.load(offsets + 2 * k + 1), 0), height - 1)
        value = tl.load(picture + y * width + x, mask=here, other=0)
        code = code * 2 + (value < centre).to(tl.int32)
    tl.store(out + i, code, mask=here)


@triton.jit(do_not_specialize=["pixels", "width", "first", "count"])
def _costs(codes, its_codes, left, right, left_valid, right_valid, out, pixels, width, first, count):
    i, here = indices(pixels * count, BLOCK)
    pixel, column = i // count, (i // count) % width
    there = column - first - i % count
    inside = here & (there >= 0) & (there < width)
    other = pixel - column + there
    unlike = tl.load(codes + pixel, mask=here, other=0) ^ tl.load(its_codes + other, mask=inside, other=0)
    unlike = unlike - ((unlike >> 1) & 0x55555555)
    unlike = (unlike & 0x33333333) + ((unlike >> 2) & 0x33333333)
    unlike = (unlike + (unlike >> 4)) & 0x0F0F0F0F
    unlike = unlike + (unlike >> 8)
    unlike = (unlike + (unlike >> 16)) & 0x3F
    a = tl.load(left + pixel, mask=here, other=0).to(tl.int32)
    b = tl.load(right + other, mask=inside, other=0).to(tl.int32)
    cost = unlike + tl.minimum(tl.abs(a - b) >> SHIFT, CAP)
    seen = tl.load(left_valid + pixel, mask=here, other=0).to(tl.int1)
    seen = seen & tl.load(right_valid + other, mask=inside, other=0).to(tl.int1)
    tl.store(out + i, tl.where(seen, cost, UNSEEN).to(tl.uint8), mask=here)


def run(left, right, left_valid, right_valid, first, count):
    height, width = left.shape
    offsets = torch.tensor(OFFSETS, dtype=torch.int32, device=left.device)
    left, right, left_valid, right_valid = (x.contiguous() for x in (left, right, left_valid, right_valid))
    codes = []
    for picture in (left, right):
        codes.append(empty(height, width, dtype=torch.int32, device=left.device))
        grid = (blocks(height * width, BLOCK),)
        launch(_signatures, grid, picture, offsets, codes[-1], height, width, OFFSETS=len(OFFSETS))
    out = empty(height, width, count, dtype=torch.uint8, device=left.device)
    pictures = *codes, left, right, left_valid, right_valid, out
    launch(_costs, (blocks(height * width * count, BLOCK),), *pictures, height * width, width, first, count)
    return out
