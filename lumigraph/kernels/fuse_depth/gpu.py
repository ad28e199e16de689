"""Triton: a program takes one block, a lane some of its voxels."""

import triton
import triton.language as tl

from .._gpu import launch
from ..block_hash import SIDE, VOXELS
from . import BEHIND_DEPTH, UNCOLOURED

S, N = tl.constexpr(SIDE), tl.constexpr(VOXELS)
MIN_DEPTH, NONE = tl.constexpr(BEHIND_DEPTH), tl.constexpr(UNCOLOURED)


@triton.jit
def _pick(values, a, b, c, d, wa, wb, wc, wd, here, stride: tl.constexpr, channel: tl.constexpr):
    """Bilinear interpolation of a channel between four pixels."""
    found = wa * tl.load(values + a * stride + channel, mask=here, other=0.0)
    found += wb * tl.load(values + b * stride + channel, mask=here, other=0.0)
    found += wc * tl.load(values + c * stride + channel, mask=here, other=0.0)
    return found + wd * tl.load(values + d * stride + channel, mask=here, other=0.0)


@triton.jit
def _if_known(depth, weight):
    return tl.where((depth > 0) & (depth < float("inf")), weight, -1.0)


@triton.jit
def _rotated(pose, x, y, z, axis: tl.constexpr):
    """One coordinate in the camera's frame."""
    return tl.load(pose + axis) * x + tl.load(pose + 4 + axis) * y + tl.load(pose + 8 + axis) * z


@triton.jit(do_not_specialize=["height", "width"])
def _fuse(
    voxels, blocks, depth, rgb, trust, pose, lens, height, width, voxel, truncation, edge, max_weight, growth
):  # fmt: skip
    number, i = tl.program_id(0).to(tl.int64), tl.arange(0, N)
    px = voxel * (tl.load(blocks + 3 * number) * S + i // (S * S)).to(tl.float32) - tl.load(pose + 3)
    py = voxel * (tl.load(blocks + 3 * number + 1) * S + i // S % S).to(tl.float32) - tl.load(pose + 7)
    pz = voxel * (tl.load(blocks + 3 * number + 2) * S + i % S).to(tl.float32) - tl.load(pose + 11)
    qz = _rotated(pose, px, py, pz, 2)
    here = qz > MIN_DEPTH
    inverse = 1 / tl.where(here, qz, 1.0)
    x = _rotated(pose, px, py, pz, 0) * inverse * tl.load(lens) + tl.load(lens + 2)
    y = _rotated(pose, px, py, pz, 1) * inverse * tl.load(lens + 1) + tl.load(lens + 3)
    wide, high = width.to(tl.float32), height.to(tl.float32)
    here = here & (x >= 0) & (y >= 0) & (x < wide) & (y < high)
    x, y = tl.where(here, x, 0.0), tl.where(here, y, 0.0)
    u, v = tl.minimum(tl.maximum(x - 0.5, 0.0), wide - 1), tl.minimum(tl.maximum(y - 0.5, 0.0), high - 1)
    left, top = u.to(tl.int32), v.to(tl.int32)
    right, below = tl.minimum(left + 1, width - 1), tl.minimum(top + 1, height - 1)
    a, b, c, d = top * width + left, top * width + right, below * width + left, below * width + right
    da, db = tl.load(depth + a, mask=here, other=0.0), tl.load(depth + b, mask=here, other=0.0)
    dc, dd = tl.load(depth + c, mask=here, other=0.0), tl.load(depth + d, mask=here, other=0.0)
    nearest = tl.minimum(tl.minimum(da, db), tl.minimum(dc, dd))
    farthest = tl.maximum(tl.maximum(da, db), tl.maximum(dc, dd))
    u, v = u - left.to(tl.float32), v - top.to(tl.float32)
    smooth = (da > 0) & (db > 0) & (dc > 0) & (dd > 0) & (farthest - nearest <= edge * nearest)
    wa, wb, wc, wd = (1 - v) * (1 - u), (1 - v) * u, v * (1 - u), v * u
    ka, kb, kc, kd = _if_known(da, wa), _if_known(db, wb), _if_known(dc, wc), _if_known(dd, wd)
    most = tl.maximum(tl.maximum(ka, kb), tl.maximum(kc, kd))
    here = here & (most >= 0)
    chosen = tl.where(ka == most, a, tl.where(kb == most, b, tl.where(kc == most, c, d)))
    a = tl.where(smooth, a, chosen)
    wa, wb = tl.where(smooth, wa, 1.0), tl.where(smooth, wb, 0.0)
    wc, wd = tl.where(smooth, wc, 0.0), tl.where(smooth, wd, 0.0)
    one = tl.load(depth + a, mask=here, other=1.0)
    # A product of 0 and a depth that is not finite would be no number.
    blended = wa * one + wb * tl.where(smooth, db, 0.0) + wc * tl.where(smooth, dc, 0.0)
    surface = blended + wd * tl.where(smooth, dd, 0.0)
    reach = 1 + growth / truncation * surface
    distance = (surface - tl.sqrt(px * px + py * py + pz * pz)) / truncation
    w = _pick(trust, a, b, c, d, wa, wb, wc, wd, here, 1, 0)
    here = here & (distance >= -reach) & (w > 0)
    place = voxels + (number * N + i) * 5
    own, weight = tl.load(place, mask=here, other=0.0), tl.load(place + 1, mask=here, other=0.0)
    share = w / tl.where(here, weight + w, 1.0)
    tl.store(place, own + share * (tl.minimum(distance, reach) - own), mask=here)
    tl.store(place + 1, tl.minimum(weight + w, max_weight), mask=here)
    here = here & (distance < reach)
    fresh = tl.load(place + 2, mask=here, other=0.0) == NONE
    for channel in tl.static_range(3):
        colour = _pick(rgb, a, b, c, d, wa, wb, wc, wd, here, 3, channel)
        before = tl.load(place + 2 + channel, mask=here, other=0.0)
        tl.store(place + 2 + channel, tl.where(fresh, colour, before + share * (colour - before)), mask=here)


def run(voxels, blocks, depth, rgb, trust, pose, lens, voxel, truncation, edge, max_weight, growth):
    given = (x.contiguous() for x in (blocks, depth, rgb, trust, pose, lens))
    numbers = *depth.shape, float(voxel), float(truncation), float(edge), float(max_weight), float(growth)
    launch(_fuse, (len(blocks),), voxels, *given, *numbers, enable_fp_fusion=False)
