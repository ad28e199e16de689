"""Triton: one lane takes one Gaussian, nearest first. The first pass counts its tiles, the second writes them.

A stable sort by tile then leaves each tile's list in order of depth.
"""

import torch
import triton
import triton.language as tl

from .._gpu import blocks, indices, launch
from ..project import MIN_ALPHA as _MIN_ALPHA

MIN_ALPHA = tl.constexpr(_MIN_ALPHA)
BLOCK = tl.constexpr(32)  # Gaussians; they go through their tiles together, so a program is as slow as its largest


@triton.jit
def _span(centre, extent, side, tiles):
    """First tile along one axis that an ellipse may touch, and their number, with half a pixel of margin."""
    first = tl.maximum(tl.floor((centre - extent) / side), 0.0)
    last = tl.minimum(tl.floor((centre + extent) / side), tiles - 1.0)
    most = tl.maximum(last - first + 1, 0.0)
    return tl.minimum(first, tiles * 1.0).to(tl.int32), most.to(tl.int32)


@triton.jit
def _edges(k, centre, side, pixels):
    """Offsets of the first and the last pixel centre of tile k from the ellipse's centre, along one axis."""
    low = k * side + 0.5
    return low - centre, tl.minimum(low + (side - 1), pixels - 0.5) - centre


@triton.jit
def _nearest(x, low, high):
    return tl.minimum(tl.maximum(x, low), high)


@triton.jit
def _least_on(x, y0, y1, c, tilt, rest):
    """Minimum of c (y + tilt x)^2 + rest x^2 for y from y0 to y1."""
    bottom = -tilt * x
    off = _nearest(bottom, y0, y1) - bottom
    return c * off * off + rest * x * x


@triton.jit(do_not_specialize=["N", "width", "height"])
def _tile(near_first, gaussians, counts, ends, pairs, N, width, height, SIDE: tl.constexpr, WRITE: tl.constexpr):
    centres, conics, opacities = gaussians
    pair_tiles, pair_numbers = pairs
    rank, here = indices(N, BLOCK)
    i = tl.load(near_first + rank, mask=here, other=0)
    cx, cy = tl.load(centres + 2 * i, mask=here, other=0.0), tl.load(centres + 2 * i + 1, mask=here, other=0.0)
    a = tl.load(conics + 3 * i, mask=here, other=1.0)
    b = tl.load(conics + 3 * i + 1, mask=here, other=0.0)
    c = tl.load(conics + 3 * i + 2, mask=here, other=1.0)
    opacity = tl.load(opacities + i, mask=here, other=0.0)
    bright = opacity > MIN_ALPHA
    a, c = tl.where(bright, a, 1.0), tl.where(bright, c, 1.0)
    reach = 2 * tl.log(tl.maximum(opacity / MIN_ALPHA, 1.0))

    # q as sums of squares, a (x + b/a y)^2 + (det/a) y^2 and the like: its three terms would cancel along a needle
    det = tl.fma(a, c, -b * b) - tl.fma(b, b, -b * b)
    tilt_x, rest_x, tilt_y, rest_y = b / a, det / a, b / c, det / c
    # A box around the ellipse; around the whole picture if the ellipse is too long and thin to tell where it ends
    wide = tl.where(det > 0, tl.sqrt(reach / tl.maximum(rest_y, 1e-30)), float("inf"))
    high = tl.where(det > 0, tl.sqrt(reach / tl.maximum(rest_x, 1e-30)), float("inf"))
    across, down = (width + SIDE - 1) // SIDE, (height + SIDE - 1) // SIDE
    left, columns = _span(cx, wide, SIDE, across)
    top, rows = _span(cy, high, SIDE, down)
    boxes = tl.where(bright, rows * columns, 0)
    columns, most = tl.maximum(columns, 1), tl.max(boxes, 0)

    count = tl.zeros([BLOCK], tl.int32)
    if WRITE:
        place = tl.load(ends + rank, mask=here, other=0) - tl.load(counts + rank, mask=here, other=0)
    box = 0
    while box < most:
        column, row = left + box % columns, top + box // columns
        x0, x1 = _edges(column, cx, SIDE, width)
        y0, y1 = _edges(row, cy, SIDE, height)
        # The least over the tile lies on an edge that faces the centre, or is 0 at the centre itself.
        x, y = _nearest(0.0, x0, x1), _nearest(0.0, y0, y1)
        least = tl.minimum(_least_on(x, y0, y1, c, tilt_y, rest_y), _least_on(y, x0, x1, a, tilt_x, rest_x))
        touched = (box < boxes) & (least <= reach)
        if WRITE:
            tl.store(pair_tiles + place + count, row * across + column, mask=touched)
            tl.store(pair_numbers + place + count, i.to(tl.int32), mask=touched)
        count += touched.to(tl.int32)
        box += 1
    if not WRITE:
        tl.store(counts + rank, count, mask=here)


@torch.no_grad()
def run(centres, conics, opacities, depths, size, side):
    (width, height), count, device = size, len(centres), centres.device
    inputs = depths.argsort(stable=True), tuple(x.contiguous() for x in (centres, conics, opacities))
    options = {"SIDE": side, "num_warps": 1, "enable_fp_fusion": False}  # both passes must round alike
    counts = torch.zeros(count, dtype=torch.int32, device=device)
    ends = torch.zeros(count, dtype=torch.int64, device=device)
    grid, pairs = (blocks(count, BLOCK),), (counts, counts)  # nothing is written into these
    launch(_tile, grid, *inputs, counts, ends, pairs, count, width, height, WRITE=False, **options)
    torch.cumsum(counts, 0, out=ends)
    total = int(ends[-1]) if count else 0
    tiles, numbers = (torch.empty(total, dtype=torch.int32, device=device) for _ in range(2))
    launch(_tile, grid, *inputs, counts, ends, (tiles, numbers), count, width, height, WRITE=True, **options)
    tiles, places = tiles.sort(stable=True)
    every = torch.arange(-(-width // side) * -(-height // side) + 1, dtype=torch.int32, device=device)
    return numbers[places], torch.searchsorted(tiles, every)
