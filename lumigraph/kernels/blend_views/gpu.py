"""Triton: penalties of all photographs at all points, then a blend of the least."""

import torch
import triton
import triton.language as tl

from .._gpu import blocks, launch
from .._operation import empty
from . import BEHIND_DEPTH, MIN_PENALTY, NOTHING, UNSEEN

MIN_DEPTH, NO_SURFACE, NEVER = tl.constexpr(BEHIND_DEPTH), tl.constexpr(NOTHING), tl.constexpr(UNSEEN)
BLOCK = tl.constexpr(128)


@triton.jit
def _row(pose, row: tl.constexpr, x, y, z):
    along = tl.load(pose + 4 * row) * x + tl.load(pose + 4 * row + 1) * y
    return along + tl.load(pose + 4 * row + 2) * z + tl.load(pose + 4 * row + 3)


@triton.jit
def _between(u, side):
    """The two pixels around a coordinate along one axis, and the interpolation weight of the second."""
    x = tl.minimum(tl.maximum(u - 0.5, 0.0), side.to(tl.float32) - 1)
    first = x.to(tl.int64)
    return first, tl.minimum(first + 1, side - 1), x - first.to(tl.float32)


@triton.jit
def _nearer(depth, at, away, gap, here):
    t = tl.load(depth + at, mask=here, other=0.0)
    return tl.where(here & (t > 0), tl.minimum(gap, tl.where(t < NO_SURFACE, tl.abs(away - t), 0.0)), gap)


@triton.jit(do_not_specialize=["count", "views", "depth_rows", "depth_columns"])
def _penalties(
    points, eyes, depths, sizes, poses, lenses, penalties, shares, places, count, views, depth_rows, depth_columns,
    focal, resolution_weight, hidden_weight, tolerance, border,
):  # fmt: skip
    i, n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK), tl.program_id(1)
    here = i < count
    pose, lens, size = poses + 12 * n, lenses + 13 * n, sizes + 4 * n
    px, py = tl.load(points + 3 * i, mask=here, other=0.0), tl.load(points + 3 * i + 1, mask=here, other=0.0)
    pz = tl.load(points + 3 * i + 2, mask=here, other=0.0)
    dx = px - tl.load(eyes + 3 * i, mask=here, other=1.0)
    dy = py - tl.load(eyes + 3 * i + 1, mask=here, other=0.0)
    dz = pz - tl.load(eyes + 3 * i + 2, mask=here, other=0.0)
    over = 1 / tl.maximum(tl.sqrt(dx * dx + dy * dy + dz * dz), MIN_DEPTH)
    x, y, z = _row(pose, 0, px, py, pz), _row(pose, 1, px, py, pz), _row(pose, 2, px, py, pz)
    here = here & (z > MIN_DEPTH)
    away = tl.sqrt(x * x + y * y + z * z)
    inverse = 1 / tl.where(here, z, 1.0)
    x, y = x * inverse, y * inverse
    s = x * x + y * y
    here = here & (s <= tl.load(lens + 12) * tl.load(lens + 12))
    s = tl.where(here, s, 0.0)
    q = 1 + s * (tl.load(lens + 4) + s * (tl.load(lens + 5) + s * tl.load(lens + 8)))
    q /= 1 + s * (tl.load(lens + 9) + s * (tl.load(lens + 10) + s * tl.load(lens + 11)))
    p1, p2 = tl.load(lens + 6), tl.load(lens + 7)
    u = (x * q + 2 * p1 * x * y + p2 * (s + 2 * x * x)) * tl.load(lens) + tl.load(lens + 2)
    v = (y * q + p1 * (s + 2 * y * y) + 2 * p2 * x * y) * tl.load(lens + 1) + tl.load(lens + 3)
    columns, rows, wide, high = tl.load(size), tl.load(size + 1), tl.load(size + 2), tl.load(size + 3)
    width, height = columns.to(tl.float32), rows.to(tl.float32)
    share = tl.minimum(tl.minimum(u, width - u) / width, tl.minimum(v, height - v) / height) / border
    here = here & (share > 0)
    u, v = tl.where(here, u, 0.5), tl.where(here, v, 0.5)
    left, right, _ = _between(u / width * wide.to(tl.float32), wide)
    top, below, _ = _between(v / height * high.to(tl.float32), high)
    depth = depths + n.to(tl.int64) * depth_rows * depth_columns
    gap = tl.full([BLOCK], NEVER, tl.float32)
    gap = _nearer(depth, top * depth_columns + left, away, gap, here)
    gap = _nearer(depth, top * depth_columns + right, away, gap, here)
    gap = _nearer(depth, below * depth_columns + left, away, gap, here)
    gap = _nearer(depth, below * depth_columns + right, away, gap, here)
    here = here & (gap < NEVER)
    gap = tl.minimum(tl.maximum(gap / tl.maximum(away, MIN_DEPTH) - tolerance, 0.0), 1.0)
    cx = (
        tl.load(pose) * tl.load(pose + 3)
        + tl.load(pose + 4) * tl.load(pose + 7)
        + tl.load(pose + 8) * tl.load(pose + 11)
    )
    cy = (
        tl.load(pose + 1) * tl.load(pose + 3)
        + tl.load(pose + 5) * tl.load(pose + 7)
        + tl.load(pose + 9) * tl.load(pose + 11)
    )
    cz = (
        tl.load(pose + 2) * tl.load(pose + 3)
        + tl.load(pose + 6) * tl.load(pose + 7)
        + tl.load(pose + 10) * tl.load(pose + 11)
    )
    cx, cy, cz = px + cx, py + cy, pz + cz
    back = 1 / tl.maximum(tl.sqrt(cx * cx + cy * cy + cz * cz), MIN_DEPTH)
    cx, cy, cz = dx * over - cx * back, dy * over - cy * back, dz * over - cz * back
    chord = tl.sqrt(cx * cx + cy * cy + cz * cz)
    coarse = tl.maximum(away * focal * over / tl.sqrt(tl.load(lens) * tl.load(lens + 1)) - 1, 0.0)
    penalty = chord * (1 + hidden_weight * gap) + resolution_weight * coarse
    there = i < count
    at = i * views + n
    tl.store(penalties + at, tl.where(here, penalty, NEVER), mask=there)
    tl.store(shares + at, tl.where(here, tl.minimum(share, 1.0), 0.0), mask=there)
    tl.store(places + 2 * at, u, mask=there)
    tl.store(places + 2 * at + 1, v, mask=there)


@triton.jit(do_not_specialize=["count", "views", "rows", "columns", "channels", "chosen_count"])
def _colours(
    pictures, sizes, chosen, weights, places, rgb, count, views, rows, columns, channels, chosen_count,
):  # fmt: skip
    i, channel = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK), tl.program_id(1)
    here = i < count
    total, value = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    for k in range(chosen_count):
        weight = tl.load(weights + i * chosen_count + k, mask=here, other=0.0)
        n = tl.load(chosen + i * chosen_count + k, mask=here, other=0)
        counts = here & (weight > 0)
        width, height = tl.load(sizes + 4 * n, mask=here, other=1), tl.load(sizes + 4 * n + 1, mask=here, other=1)
        place = places + 2 * (i * views + n)
        left, right, x = _between(tl.load(place, mask=counts, other=0.5), width)
        top, below, y = _between(tl.load(place + 1, mask=counts, other=0.5), height)
        picture = pictures + channels * n * rows * columns + channel
        a = tl.load(picture + channels * (top * columns + left), mask=counts, other=0).to(tl.float32)
        b = tl.load(picture + channels * (top * columns + right), mask=counts, other=0).to(tl.float32)
        c = tl.load(picture + channels * (below * columns + left), mask=counts, other=0).to(tl.float32)
        d = tl.load(picture + channels * (below * columns + right), mask=counts, other=0).to(tl.float32)
        value += weight * ((1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d))
        total += weight
    tl.store(rgb + channels * i + channel, value / (255 * tl.maximum(total, 1e-12)), mask=here)


def run(
    points, eyes, focal, pictures, depths, sizes, poses, lenses, count, resolution_weight, hidden_weight, tolerance,
    border,
):  # fmt: skip
    pixels, views, device = len(points), len(pictures), points.device
    penalties, shares = (empty(pixels, views, device=device) for _ in range(2))
    places, rgb = empty(pixels, views, 2, device=device), empty(pixels, pictures.shape[3], device=device)
    sizes = sizes.long()
    given = (x.contiguous() for x in (points, eyes, depths, sizes, poses, lenses))
    weights = resolution_weight, hidden_weight, tolerance, border
    grid = blocks(pixels, BLOCK), views
    launch(
        _penalties, grid, *given, penalties, shares, places, pixels, views, *depths.shape[1:], float(focal), *weights
    )
    least, chosen = penalties.topk(min(count + 1, views), 1, largest=False)
    last = least[:, count:] if count < views else torch.full_like(least[:, :1], UNSEEN)
    share = shares.gather(1, chosen)
    weight = share * (1 - least / last.clamp_min(MIN_PENALTY)).clamp_min(0) / (least + MIN_PENALTY)
    weight = torch.where((weight.sum(1, keepdim=True) > 0) & (least < UNSEEN), weight, torch.zeros_like(weight))
    even = (weight.sum(1, keepdim=True) == 0) & (least < UNSEEN)
    weight = torch.where(even, share, weight).contiguous()
    sources = pictures.contiguous(), sizes.contiguous(), chosen.contiguous(), weight, places
    launch(
        _colours,
        (blocks(pixels, BLOCK), pictures.shape[3]),
        *sources,
        rgb,
        pixels,
        views,
        *pictures.shape[1:],
        chosen.shape[1],
    )
    return rgb, torch.where(weight > 0, share, torch.zeros_like(share)).amax(1)
