"""Triton: one lane takes one ray. Gradients of the rows meet in atomic adds."""

import torch
import triton
import triton.language as tl

from .._gpu import blocks, indices, launch, load_row
from .._operation import differentiable, empty
from ..sparse_grid.gpu import corner_of, weight_of
from . import ALPHA, CHANNELS
from .reference import MIN_STRIDE_DIVISOR

BLOCK = tl.constexpr(32)  # rays; they march together, so a program is as slow as its slowest
C, A = tl.constexpr(CHANNELS), tl.constexpr(ALPHA)
MIN_DIVISOR = tl.constexpr(MIN_STRIDE_DIVISOR)
SURE_STEP = tl.constexpr(0.9)  # voxels of a step, in a count of steps that must not lead too far


@triton.jit
def _placed(ox, oy, oz, dx, dy, dz, t, ball, CURVED: tl.constexpr):
    """Grid position of each ray at a distance; contracted, if there is a ball (Barron 2022, eq. 10)."""
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    if CURVED:
        middle = 2 * ball - 0.5
        u, v, w = x - middle, y - middle, z - middle
        share = ball / tl.maximum(tl.sqrt(u * u + v * v + w * w), ball)
        scale = (2 - share) * share
        x, y, z = middle + scale * u, middle + scale * v, middle + scale * w
    return x, y, z


@triton.jit
def _nearest(ox, oy, oz, dx, dy, dz, ball):
    """Distance from a ray's point closest to the ball's centre to its origin, and that point's squared radius."""
    middle = 2 * ball - 0.5
    u, v, w = ox - middle, oy - middle, oz - middle
    along = u * dx + v * dy + w * dz
    u, v, w = u - along * dx, v - along * dy, w - along * dz
    return along, u * u + v * v + w * w


@triton.jit
def _later(t, steps, along, aside, ball, CURVED: tl.constexpr):
    """Distance after so many more steps. along, aside: of `_nearest`"""
    if CURVED:
        while tl.max(steps, 0) > 0:
            radius = tl.maximum(tl.sqrt(aside + (along + t) * (along + t)), 1e-6)
            share = ball / tl.maximum(radius, ball)
            speed = tl.sqrt(1 + 4 * aside / (ball * ball) * (1 - share)) * share * ball
            stride = radius / tl.maximum(speed - (along + t) / radius, MIN_DIVISOR)
            t += tl.where(steps > 0, tl.where(radius <= ball, 1.0, stride), 0.0)
            steps -= 1
    else:
        t += steps.to(tl.float32)
    return t


@triton.jit
def _block_of(x, y, z, index, here, X, Y, Z, B: tl.constexpr):
    """Coordinates and number of the block at each position; number -1 outside the grid and for no block."""
    bx = tl.floor((x + 0.5) / B).to(tl.int32)
    by = tl.floor((y + 0.5) / B).to(tl.int32)
    bz = tl.floor((z + 0.5) / B).to(tl.int32)
    inside = here & (bx >= 0) & (by >= 0) & (bz >= 0) & (bx < X) & (by < Y) & (bz < Z)
    return bx, by, bz, tl.load(index + (bx.to(tl.int64) * Y + by) * Z + bz, mask=inside, other=-1)


@triton.jit
def _to_side(x, d, b, B: tl.constexpr):
    """Distance along the ray to its exit from block b of one axis."""
    still = tl.abs(d) < 1e-9
    side = (B * (b + (d > 0).to(tl.int32))).to(tl.float32) - 0.5
    return tl.where(still, 1e9, (side - x) / tl.where(still, 1.0, d))


@triton.jit
def _from_sides(x, b, B: tl.constexpr):
    """Distance along one axis to the nearer side of block b."""
    inside = x + 0.5 - (B * b).to(tl.float32)
    return tl.minimum(inside, B - inside)


@triton.jit
def _cell_of(x, b, B: tl.constexpr):
    """Along one axis: the voxel below a position, counted within its block, and the fractional position above it."""
    place = x - (B * b).to(tl.float32) + 1.0
    cell = tl.minimum(tl.maximum(place.to(tl.int32), 0), B)
    return cell, place - cell.to(tl.float32)


@triton.jit
def _voxel_of(x, y, z, bx, by, bz, B: tl.constexpr):
    """The lowest of the eight voxels around each position, within its block, and the fractional position above."""
    cx, fx = _cell_of(x, bx, B)  # one pair a line: Triton 3.6 assigns to no nested tuple
    cy, fy = _cell_of(y, by, B)
    cz, fz = _cell_of(z, bz, B)
    return (cx, cy, cz), (fx, fy, fz)


@triton.jit
def _row_of(rows, number, voxel, there, B: tl.constexpr):
    at = ((number.to(tl.int64) * (B + 2) + voxel[0]) * (B + 2) + voxel[1]) * (B + 2) + voxel[2]
    return tl.load(rows + at, mask=there, other=-1)


@triton.jit
def _blended(rows, values, number, voxel, f, there, B: tl.constexpr):
    """Trilinear values at each position, and a mask of those with a non-empty voxel."""
    c = tl.arange(0, C)
    v = tl.zeros([BLOCK, C], tl.float32)
    some = tl.zeros([BLOCK], tl.int32)
    for k in tl.static_range(8):
        weight = weight_of(k, f)
        row = _row_of(rows, number, corner_of(k, voxel), there, B).to(tl.int64)
        full = row >= 0
        some |= full.to(tl.int32)
        v += weight[:, None] * tl.load(values + row[:, None] * C + c[None, :], mask=full[:, None], other=0.0)
    return v, some > 0


@triton.jit
def _alpha(v):
    return tl.sum(tl.where(tl.arange(0, C)[None, :] == A, v, 0.0), 1)


@triton.jit(do_not_specialize=["R"])
def _march(
    rays, grid, values, sums, noted, R, X, Y, Z, ball, stop, NOTE: tl.constexpr, CURVED: tl.constexpr, B: tl.constexpr
):
    """Composite along each ray; or, with NOTE, store its non-empty steps and their transmittances."""
    origins, directions, enter, leave = rays
    index, rows = grid
    totals, distance, lengths = sums
    starts, steps, transmittances = noted
    r, here = indices(R, BLOCK)
    c = tl.arange(0, C)
    ox, oy, oz = load_row(origins, r, here)
    dx, dy, dz = load_row(directions, r, here, 1.0)
    t = tl.load(enter + r, mask=here, other=0.0)
    end = tl.load(leave + r, mask=here, other=0.0)
    if NOTE:
        first = tl.load(starts + r, mask=here, other=0)
        last = tl.load(starts + r + 1, mask=here, other=0)
    transmittance = tl.full([BLOCK], 1.0, tl.float32)
    along = tl.zeros([BLOCK], tl.float32)
    total = tl.zeros([BLOCK, C], tl.float32)
    met = tl.zeros([BLOCK], tl.int32)
    ahead, aside = _nearest(ox, oy, oz, dx, dy, dz, ball)
    alive = here & (t < end) & (transmittance >= stop)
    while tl.max(alive.to(tl.int32), 0) > 0:
        x, y, z = _placed(ox, oy, oz, dx, dy, dz, t, ball, CURVED)
        bx, by, bz, number = _block_of(x, y, z, index, alive, X, Y, Z, B)
        there = number >= 0
        voxel, f = _voxel_of(x, y, z, bx, by, bz, B)
        nearest = _row_of(rows, number, voxel, there, B)
        leap = tl.where(nearest < -1, -1 - nearest, 0)
        if CURVED:  # a step may be longer than a voxel
            leap = tl.maximum(leap - 1, 0)
        there &= leap == 0
        v, some = _blended(rows, values, number, voxel, f, there, B)
        alpha = _alpha(v)
        if NOTE:
            place = first + met
            tl.store(steps + place, t, mask=some & (place < last))
            tl.store(transmittances + place, transmittance, mask=some & (place < last))
        total += transmittance[:, None] * v
        along += transmittance * alpha * t
        transmittance *= 1 - alpha
        met += some.to(tl.int32)
        if CURVED:
            clear = tl.minimum(tl.minimum(_from_sides(x, bx, B), _from_sides(y, by, B)), _from_sides(z, bz, B))
            out = ((clear + (B * (-1 - number)).to(tl.float32)) * SURE_STEP).to(tl.int32)
        else:
            away = tl.minimum(tl.minimum(_to_side(x, dx, bx, B), _to_side(y, dy, by, B)), _to_side(z, dz, bz, B))
            out = tl.ceil(tl.minimum(away, 1e9)).to(tl.int32)
        onward = tl.where(alive, tl.maximum(tl.where(number < 0, out, leap), 1), 0)
        t = _later(t, onward, ahead, aside, ball, CURVED)
        alive &= (t < end) & (transmittance >= stop)
    if not NOTE:
        tl.store(totals + r[:, None] * C + c[None, :], total, mask=here[:, None])
        tl.store(distance + r, along, mask=here)
        tl.store(lengths + r, met, mask=here)


@triton.jit(do_not_specialize=["R"])
def _backward(grads, rays, grid, values, noted, to_values, R, X, Y, Z, ball, CURVED: tl.constexpr, B: tl.constexpr):
    """Gradients of rows, back to front along each ray: dL/dv = T g; alpha also gets what it occludes."""
    g_totals, g_distance = grads
    origins, directions = rays
    index, rows = grid
    starts, steps, transmittances = noted
    r, here = indices(R, BLOCK)
    c = tl.arange(0, C)
    ox, oy, oz = load_row(origins, r, here)
    dx, dy, dz = load_row(directions, r, here, 1.0)
    g = tl.load(g_totals + r[:, None] * C + c[None, :], mask=here[:, None], other=0.0)
    g_along = tl.load(g_distance + r, mask=here, other=0.0)
    first = tl.load(starts + r, mask=here, other=0)
    s = tl.load(starts + r + 1, mask=here, other=0) - 1
    hidden = tl.zeros([BLOCK], tl.float32)
    alive = here & (s >= first)
    while tl.max(alive.to(tl.int32), 0) > 0:
        t = tl.load(steps + s, mask=alive, other=0.0)
        transmittance = tl.load(transmittances + s, mask=alive, other=0.0)
        x, y, z = _placed(ox, oy, oz, dx, dy, dz, t, ball, CURVED)
        bx, by, bz, number = _block_of(x, y, z, index, alive, X, Y, Z, B)
        there = number >= 0
        voxel, f = _voxel_of(x, y, z, bx, by, bz, B)
        v, _ = _blended(rows, values, number, voxel, f, there, B)
        alpha = _alpha(v)
        d_v = transmittance[:, None] * (g + tl.where(c[None, :] == A, (g_along * t - hidden)[:, None], 0.0))
        for k in tl.static_range(8):
            weight = weight_of(k, f)
            row = _row_of(rows, number, corner_of(k, voxel), there, B).to(tl.int64)
            to = to_values + row[:, None] * C + c[None, :]
            tl.atomic_add(to, weight[:, None] * d_v, mask=(row >= 0)[:, None], sem="relaxed")
        own = tl.sum(g * v, 1) + g_along * alpha * t
        hidden = tl.where(alive, own + (1 - alpha) * hidden, hidden)
        s -= 1
        alive &= s >= first


def forward(ctx, origins, directions, enter, leave, voxels, values, stop):
    device, rays = origins.device, len(origins)
    ctx.voxels = voxels.index.contiguous(), voxels.rows.contiguous()
    ctx.grid, ctx.sizes, ctx.stop = (blocks(rays, BLOCK),), (rays, *voxels.index.shape, float(voxels.ball)), float(stop)
    ctx.options = {"CURVED": voxels.ball > 0, "B": voxels.block, "num_warps": 1, "enable_fp_fusion": False}
    totals, distance = empty(rays, CHANNELS, device=device), empty(rays, device=device)
    lengths = torch.zeros(rays, dtype=torch.int32, device=device)
    out, noted = (totals, distance, lengths), (lengths, distance, distance)  # into `noted` nothing is written here
    given = (origins, directions, enter, leave), ctx.voxels, values, out, noted
    launch(_march, ctx.grid, *given, *ctx.sizes, ctx.stop, NOTE=False, **ctx.options)
    ctx.save_for_backward(origins, directions, enter, leave, values, *out)
    return totals, distance


def backward(ctx, *grads):
    origins, directions, enter, leave, values, totals, distance, lengths = ctx.saved_tensors
    starts = torch.nn.functional.pad(lengths.long().cumsum(0), (1, 0))
    steps = torch.zeros(int(starts[-1]), device=values.device)
    transmittances, to_values = empty(len(steps), device=values.device), torch.zeros_like(values)
    out, noted = (totals, distance, lengths), (starts, steps, transmittances)
    given = (origins, directions, enter, leave), ctx.voxels, values, out, noted
    launch(_march, ctx.grid, *given, *ctx.sizes, ctx.stop, NOTE=True, **ctx.options)
    inputs = grads, (origins, directions), ctx.voxels, values, noted, to_values
    launch(_backward, ctx.grid, *inputs, *ctx.sizes, **ctx.options)
    return None, None, None, None, None, to_values, None


run = differentiable(forward, backward)
