"""Triton: one lane takes one ray. It skips a missing block in one step."""

import triton
import triton.language as tl

from .._gpu import blocks as programs
from .._gpu import indices, launch, load_row, store_row
from .._operation import empty
from ..block_hash.gpu import find
from .reference import GREY as MIDDLE

GREY = tl.constexpr(MIDDLE)
BLOCK = tl.constexpr(64)


@triton.jit
def _corner(x, y, z, voxels, blocks, table, mask, here, c: tl.constexpr):
    """Distance, weight and row of one of the eight voxels from (x, y, z) on; weight 0 in a missing block."""
    x, y, z = x + c // 4, y + c // 2 % 2, z + c % 2
    number = find(x >> 3, y >> 3, z >> 3, blocks, table, mask, here)
    there = here & (number >= 0)
    place = voxels + 5 * (number.to(tl.int64) * 512 + ((x & 7) * 8 + (y & 7)) * 8 + (z & 7))
    return tl.load(place, mask=there, other=0.0), tl.load(place + 1, mask=there, other=0.0), place


@triton.jit
def _share(part, far: tl.constexpr):
    return part if far else 1 - part


@triton.jit
def _exit(base, p, d, inverse):
    """Distance in voxels along a ray to its exit from the block of a voxel, along one axis."""
    face = ((base >> 3) + (d > 0).to(tl.int32)) * 8
    return tl.where(d == 0, float("inf"), (face.to(tl.float32) - p) * inverse)


@triton.jit
def _inverse(d):
    return 1.0 / tl.where(d == 0, 1.0, d)


@triton.jit(do_not_specialize=["R", "mask"])
def _cast(
    origins, directions, nears, fars, voxels, blocks, table, out, normals, rgbs, R, mask, per_unit, step
):  # fmt: skip
    r, real = indices(R, BLOCK)
    ox, oy, oz = load_row(origins, r, real)
    dx, dy, dz = load_row(directions, r, real, 1.0)
    near, far = tl.load(nears + r, mask=real, other=0.0), tl.load(fars + r, mask=real, other=0.0)
    ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
    found = tl.full([BLOCK], float("inf"), tl.float32)
    before = tl.full([BLOCK], float("nan"), tl.float32)
    k = tl.zeros([BLOCK], tl.int32)
    alive = real & (near < far)
    while tl.max(alive.to(tl.int32), 0) > 0:
        t = near + k.to(tl.float32) * step
        px, py, pz = (ox + t * dx) * per_unit, (oy + t * dy) * per_unit, (oz + t * dz) * per_unit
        fx, fy, fz = tl.floor(px), tl.floor(py), tl.floor(pz)
        x, y, z = fx.to(tl.int32), fy.to(tl.int32), fz.to(tl.int32)
        there = alive & (find(x >> 3, y >> 3, z >> 3, blocks, table, mask, alive) >= 0)
        known = there
        distance = tl.zeros([BLOCK], tl.float32)
        for c in tl.static_range(8):
            d, w, _ = _corner(x, y, z, voxels, blocks, table, mask, there, c)
            distance += d * _share(px - fx, c // 4) * _share(py - fy, c // 2 % 2) * _share(pz - fz, c % 2)
            known = known & (w > 0)
        through = known & (distance < 0) & (before >= 0)
        found = tl.where(through, t - step + step * before / (before - tl.where(through, distance, -1.0)), found)
        before = tl.where(known, distance, float("nan"))
        leave = tl.minimum(_exit(x, px, dx, ix), tl.minimum(_exit(y, py, dy, iy), _exit(z, pz, dz, iz))) / per_unit
        stride = tl.ceil(tl.minimum(leave / step - 0.02, 1e8)).to(tl.int32)
        k += tl.where(there, 1, tl.maximum(stride, 1))
        alive = alive & (~through) & (near + k.to(tl.float32) * step < far)
    hit = real & (found < float("inf"))
    t = tl.where(hit, found, 0.0)
    px, py, pz = (ox + t * dx) * per_unit, (oy + t * dy) * per_unit, (oz + t * dz) * per_unit
    fx, fy, fz = tl.floor(px), tl.floor(py), tl.floor(pz)
    x, y, z = fx.to(tl.int32), fy.to(tl.int32), fz.to(tl.int32)
    u, v, s = px - fx, py - fy, pz - fz
    known = hit
    gx, gy, gz = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    red, green, blue = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    total = tl.zeros([BLOCK], tl.float32)
    for c in tl.static_range(8):
        d, w, place = _corner(x, y, z, voxels, blocks, table, mask, hit, c)
        su, sv, ss = _share(u, c // 4), _share(v, c // 2 % 2), _share(s, c % 2)
        known = known & (w > 0)
        gx += d * (2 * (c // 4) - 1) * sv * ss
        gy += d * (2 * (c // 2 % 2) - 1) * su * ss
        gz += d * (2 * (c % 2) - 1) * su * sv
        painted = hit & (w > 0)
        painted = painted & (tl.load(place + 2, mask=painted, other=-1.0) >= 0)
        share = tl.where(painted, su * sv * ss, 0.0)
        total += share
        red += share * tl.load(place + 2, mask=painted, other=0.0)
        green += share * tl.load(place + 3, mask=painted, other=0.0)
        blue += share * tl.load(place + 4, mask=painted, other=0.0)
    length = tl.sqrt(gx * gx + gy * gy + gz * gz)
    known = known & (length > 1e-6)
    inverse = 1 / tl.where(known, length, 1.0)
    normal = (
        tl.where(known, gx * inverse, -dx), tl.where(known, gy * inverse, -dy), tl.where(known, gz * inverse, -dz)
    )  # fmt: skip
    painted = hit & (total > 1e-6)
    inverse = 1 / tl.where(painted, total, 1.0)
    rgb = (
        tl.where(painted, red * inverse, GREY),
        tl.where(painted, green * inverse, GREY),
        tl.where(painted, blue * inverse, GREY),
    )
    tl.store(out + r, found, mask=real)
    store_row(normals, r, normal, real)
    store_row(rgbs, r, rgb, real)


def run(origins, directions, t_near, t_far, voxels, blocks, table, voxel, step):
    rays, device = len(origins), origins.device
    out, normal, rgb = empty(rays, device=device), empty(rays, 3, device=device), empty(rays, 3, device=device)
    given = (x.contiguous() for x in (origins, directions, t_near, t_far, voxels, blocks, table))
    numbers = rays, len(table) - 1, 1 / voxel, float(step)
    options = {"num_warps": 2, "enable_fp_fusion": False}
    launch(_cast, (programs(rays, BLOCK),), *given, out, normal, rgb, *numbers, **options)
    return out, normal, rgb
