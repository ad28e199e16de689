"""Triton: one lane takes one point on one ray and writes its block unless the table has it."""

import torch
import triton
import triton.language as tl

from .._gpu import blocks as programs
from .._gpu import indices, launch
from ..block_hash.gpu import find

BLOCK = tl.constexpr(128)


@triton.jit
def direction(x, y, pose, lens):
    """Unit direction of the ray through the centre of a pixel (column, row)."""
    u = (x.to(tl.float32) + 0.5 - tl.load(lens + 2)) / tl.load(lens)
    v = (y.to(tl.float32) + 0.5 - tl.load(lens + 3)) / tl.load(lens + 1)
    length = 1 / tl.sqrt(u * u + v * v + 1)
    dx = (tl.load(pose) * u + tl.load(pose + 1) * v + tl.load(pose + 2)) * length
    dy = (tl.load(pose + 4) * u + tl.load(pose + 5) * v + tl.load(pose + 6)) * length
    dz = (tl.load(pose + 8) * u + tl.load(pose + 9) * v + tl.load(pose + 10)) * length
    return dx, dy, dz


@triton.jit(do_not_specialize=["count", "width", "steps"])
def _walk(depth, pose, lens, blocks, table, out, fresh, count, width, steps, mask, side, truncation):
    i, here = indices(count, BLOCK)
    pixel, k = i // (steps + 1), i % (steps + 1)
    t = tl.load(depth + pixel, mask=here, other=0.0)
    here = here & (t > 0) & (t < float("inf"))
    t = tl.where(here, t, 1.0)
    dx, dy, dz = direction(pixel % width, pixel // width, pose, lens)
    t += 2 * truncation / steps.to(tl.float32) * k.to(tl.float32) - truncation
    x = tl.floor((tl.load(pose + 3) + t * dx) / side).to(tl.int32)
    y = tl.floor((tl.load(pose + 7) + t * dy) / side).to(tl.int32)
    z = tl.floor((tl.load(pose + 11) + t * dz) / side).to(tl.int32)
    new = here & (find(x, y, z, blocks, table, mask, here) < 0)
    tl.store(out + 3 * i, x, mask=new)
    tl.store(out + 3 * i + 1, y, mask=new)
    tl.store(out + 3 * i + 2, z, mask=new)
    tl.store(fresh + i, new.to(tl.uint8), mask=i < count)


def run(depth, pose, lens, blocks, table, side, truncation, steps):
    count, width = depth.numel() * (steps + 1), depth.shape[1]
    out = torch.empty(count, 3, dtype=torch.int32, device=depth.device)
    fresh = torch.empty(count, dtype=torch.uint8, device=depth.device)
    given = *(x.contiguous() for x in (depth, pose, lens, blocks, table)), out, fresh
    numbers = count, width, steps, len(table) - 1, side, truncation
    launch(_walk, (programs(count, BLOCK),), *given, *numbers, enable_fp_fusion=False)
    return out[fresh.bool()].unique(dim=0)
