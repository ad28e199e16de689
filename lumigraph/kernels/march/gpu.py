"""Triton: one lane takes one ray. The first pass counts samples, the second writes them."""

import math

import torch
import triton
import triton.language as tl

from .._gpu import blocks, indices, launch, load_row
from .._operation import empty

BLOCK = tl.constexpr(32)  # rays; they march together, so a program is as slow as its slowest


@triton.jit
def _lattice(k, t_near, step, knee, log_growth):
    """t_k: constant steps up to index knee, geometric from there."""
    linear = tl.fma(tl.minimum(k, knee).to(tl.float32), step, t_near)
    return linear * tl.exp(tl.maximum(k - knee, 0).to(tl.float32) * log_growth)


@triton.jit
def _first_at(t, t_near, step, knee, growth, log_growth, GROWS: tl.constexpr):
    """First interval whose midpoint lies at or beyond t, or a few before it, so that rounding skips none."""
    k = (t - t_near) / step - 0.5
    if GROWS:
        t_knee = tl.fma(knee.to(tl.float32), step, t_near)
        further = tl.log(tl.maximum(t, t_knee) / (t_knee * (1 + 0.5 * growth))) / log_growth
        k = tl.where(t > t_knee, knee.to(tl.float32) + further, k)
    return tl.ceil(tl.minimum(tl.maximum(k, 0.0), 1e9) - 0.02).to(tl.int32)


@triton.jit
def _slab(o, inverse, reach):
    """Distances at which a ray passes the planes -reach and reach of one axis."""
    a, b = (-reach - o) * inverse, (reach - o) * inverse
    return tl.minimum(a, b), tl.maximum(a, b)


@triton.jit
def _inverse(d):
    """1 / d, large where d is zero: such a ray never reaches the next plane of that axis."""
    return 1.0 / tl.where(tl.abs(d) < 1e-12, 1e-12, d)


@triton.jit
def _cell(x, inverse_scale, n: tl.constexpr):
    i = ((x * inverse_scale + 1) * (0.5 * n)).to(tl.int32)
    return tl.minimum(tl.maximum(i, 0), n - 1)


@triton.jit
def _to_face(x, i, d, inverse, scale, n: tl.constexpr):
    """Distance along the ray to its exit from cell i of one axis."""
    face = ((i + (d > 0).to(tl.int32)).to(tl.float32) * (2.0 / n) - 1) * scale
    return (face - x) * inverse


@triton.jit(do_not_specialize=["R"])
def _march(
    origins, directions, t_nears, t_fars, occupied, density, counts, ray_starts, t_start, t_end,
    R, step, growth, log_growth, most,
    CASCADES: tl.constexpr, n: tl.constexpr, SKIP: tl.constexpr, GROWS: tl.constexpr, STOP: tl.constexpr,
    WRITE: tl.constexpr,
):  # fmt: skip
    r, here = indices(R, BLOCK)
    ox, oy, oz = load_row(origins, r, here)
    dx, dy, dz = load_row(directions, r, here, 1.0)
    t_near = tl.load(t_nears + r, mask=here, other=0.0)
    t_far = tl.load(t_fars + r, mask=here, other=0.0)
    ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)

    # nothing lies outside the last cascade
    reach = 2.0 ** (CASCADES - 1)
    in_x, out_x = _slab(ox, ix, reach)
    in_y, out_y = _slab(oy, iy, reach)
    in_z, out_z = _slab(oz, iz, reach)
    t_in = tl.maximum(tl.maximum(in_x, in_y), tl.maximum(in_z, t_near))
    t_far = tl.minimum(tl.minimum(out_x, out_y), tl.minimum(out_z, t_far))
    alive = here & (t_near < t_far) & (t_in < t_far)

    knee = tl.full([BLOCK], 2**30, tl.int32)
    if GROWS:
        knee = tl.maximum(tl.ceil((step / growth - t_near) / step), 0.0).to(tl.int32)
    k = _first_at(tl.where(alive, t_in, t_near), t_near, step, knee, growth, log_growth, GROWS)
    count = tl.zeros([BLOCK], tl.int32)
    thickness = tl.zeros([BLOCK], tl.float32)
    if WRITE:
        first = tl.load(ray_starts + r, mask=here, other=0)
        last = tl.load(ray_starts + r + 1, mask=here, other=0)

    while tl.max(alive.to(tl.int32), 0) > 0:
        t0 = _lattice(k, t_near, step, knee, log_growth)
        t1 = _lattice(k + 1, t_near, step, knee, log_growth)
        middle = 0.5 * (t0 + t1)
        alive &= middle < t_far
        x, y, z = tl.fma(middle, dx, ox), tl.fma(middle, dy, oy), tl.fma(middle, dz, oz)

        distance = tl.maximum(tl.maximum(tl.abs(x), tl.abs(y)), tl.abs(z))
        cascade = tl.zeros([BLOCK], tl.int32)
        scale = tl.full([BLOCK], 1.0, tl.float32)
        inverse_scale = tl.full([BLOCK], 1.0, tl.float32)
        for c in tl.static_range(CASCADES - 1):
            coarser = distance >= 2.0**c
            cascade += coarser.to(tl.int32)
            scale = tl.where(coarser, 2.0 ** (c + 1), scale)
            inverse_scale = tl.where(coarser, 0.5 ** (c + 1), inverse_scale)
        held = alive & (distance < reach)
        cx, cy, cz = _cell(x, inverse_scale, n), _cell(y, inverse_scale, n), _cell(z, inverse_scale, n)
        cell = ((cascade * n + cx) * n + cy) * n + cz
        kept = held & (tl.load(occupied + cell, mask=held, other=0) != 0)
        if WRITE:
            place = first + count
            tl.store(t_start + place, t0, mask=kept & (place < last))
            tl.store(t_end + place, t1, mask=kept & (place < last))
        count += kept.to(tl.int32)
        if STOP:
            thickness += tl.load(density + cell, mask=kept, other=0.0) * (t1 - t0)
            alive &= thickness <= most

        onward = k + 1
        if SKIP:  # an empty cell is left in one stride
            to_x = _to_face(x, cx, dx, ix, scale, n)
            to_y = _to_face(y, cy, dy, iy, scale, n)
            to_z = _to_face(z, cz, dz, iz, scale, n)
            leave = middle + tl.minimum(tl.minimum(to_x, to_y), to_z)
            beyond = _first_at(leave, t_near, step, knee, growth, log_growth, GROWS)
            onward = tl.where(held & ~kept, tl.maximum(onward, beyond), onward)
        k = tl.where(alive, onward, k)

    if not WRITE:
        tl.store(counts + r, count, mask=here)


@torch.no_grad()
def run(origins, directions, t_near, t_far, occupied, density, step, growth, stop):
    rays, (cascades, n) = len(origins), occupied.shape[:2]
    inputs = [x.contiguous() for x in (origins, directions, t_near, t_far, occupied.view(torch.uint8), density)]
    numbers = (rays, float(step), float(growth), math.log1p(growth), -math.log(stop) if stop > 0 else math.inf)
    options = {
        "CASCADES": cascades,
        "n": n,
        "SKIP": cascades == 1 or n % 4 == 0,  # else a cell may reach into the finer cascade
        "GROWS": growth > 0,
        "STOP": stop > 0,
        "num_warps": 1,
        "enable_fp_fusion": False,  # both passes must round alike
    }
    grid = (blocks(rays, BLOCK),)
    counts = torch.zeros(rays, dtype=torch.int32, device=origins.device)
    ray_starts = torch.zeros(rays + 1, dtype=torch.int64, device=origins.device)
    t_start = t_end = empty(0, device=origins.device)
    launch(_march, grid, *inputs, counts, ray_starts, t_start, t_end, *numbers, WRITE=False, **options)
    torch.cumsum(counts, 0, out=ray_starts[1:])
    t_start, t_end = (empty(int(ray_starts[-1]), device=origins.device) for _ in range(2))
    launch(_march, grid, *inputs, counts, ray_starts, t_start, t_end, *numbers, WRITE=True, **options)
    return t_start, t_end, ray_starts
