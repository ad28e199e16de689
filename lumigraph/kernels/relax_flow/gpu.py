"""Triton: a launch for the pixels of each colour in turn."""

import torch
import triton
import triton.language as tl

from .._gpu import blocks, indices, launch

BLOCK = tl.constexpr(256)


@triton.jit
def _pull(flow, weights, i, apart, at, here, total, u, v):
    """Add w and w times the flow of a neighbour `apart` from pixel i; its weight is at `at`."""
    w = tl.load(weights + at, mask=here, other=0.0)
    u += w * tl.load(flow + 2 * (i + apart), mask=here, other=0.0)
    v += w * tl.load(flow + 2 * (i + apart) + 1, mask=here, other=0.0)
    return total + w, u, v


@triton.jit(do_not_specialize=["height", "width", "odd"])
def _half_step(flow, data, right, below, height, width, odd, relaxation):
    i, here = indices(height * width, BLOCK)
    y, x = i // width, i % width
    here = here & ((x + y) % 2 == odd)
    u, v = tl.load(data + 5 * i + 3, mask=here, other=0.0), tl.load(data + 5 * i + 4, mask=here, other=0.0)
    total = tl.zeros([BLOCK], tl.float32)
    total, u, v = _pull(flow, right, i, 1, i, here & (x + 1 < width), total, u, v)
    total, u, v = _pull(flow, right, i, -1, i - 1, here & (x > 0), total, u, v)
    total, u, v = _pull(flow, below, i, width, i, here & (y + 1 < height), total, u, v)
    total, u, v = _pull(flow, below, i, -width, i - width, here & (y > 0), total, u, v)
    a, b = tl.load(data + 5 * i, mask=here, other=1.0), tl.load(data + 5 * i + 1, mask=here, other=0.0)
    c = tl.load(data + 5 * i + 2, mask=here, other=1.0)
    own_u, own_v = tl.load(flow + 2 * i, mask=here, other=0.0), tl.load(flow + 2 * i + 1, mask=here, other=0.0)
    own_u += relaxation * ((u - b * own_v) / (a + total) - own_u)
    own_v += relaxation * ((v - b * own_u) / (c + total) - own_v)
    tl.store(flow + 2 * i, own_u, mask=here)
    tl.store(flow + 2 * i + 1, own_v, mask=here)


def run(start, data, right, below, iterations, relaxation):
    out = start.clone(memory_format=torch.contiguous_format)
    given = [x.contiguous() for x in (data, right, below)]
    for step in range(2 * iterations):
        grid = (blocks(right.numel(), BLOCK),)
        launch(_half_step, grid, out, *given, *right.shape, step % 2, float(relaxation))
    return out
