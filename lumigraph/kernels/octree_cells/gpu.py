"""Triton: one lane takes one ray, and descends from the root to each cell; a pass counts, another writes."""

import math

import torch
import triton
import triton.language as tl

from .._gpu import blocks, indices, launch, load_row
from .._operation import empty
from . import MIN_SPEED as _MIN_SPEED

MIN_SPEED = tl.constexpr(_MIN_SPEED)
BLOCK = tl.constexpr(32)  # rays; they go together, so a program is as slow as its slowest


@triton.jit
def cell_at(x, low, high, side):
    """Integer coordinate of the smallest cell at x, clamped to [low, high)."""
    inside = tl.minimum(tl.maximum(x * side, -1.0), side + 1.0)
    return tl.minimum(tl.maximum(tl.floor(inside).to(tl.int32), low), high - 1)


@triton.jit
def enter(origins, directions, r, here, near, DEPTH: tl.constexpr):
    """Rays (origins, directions, inverse directions), entry distances, a mask of hits, and entry cells."""
    ox, oy, oz = load_row(origins, r, here)
    dx, dy, dz = load_row(directions, r, here, 1.0)
    ix = 1.0 / tl.where(tl.abs(dx) < MIN_SPEED, MIN_SPEED, dx)
    iy = 1.0 / tl.where(tl.abs(dy) < MIN_SPEED, MIN_SPEED, dy)
    iz = 1.0 / tl.where(tl.abs(dz) < MIN_SPEED, MIN_SPEED, dz)
    a, b, c = -ox * ix, -oy * iy, -oz * iz
    d, e, f = (1.0 - ox) * ix, (1.0 - oy) * iy, (1.0 - oz) * iz
    first = tl.maximum(tl.maximum(tl.minimum(a, d), tl.minimum(b, e)), tl.minimum(c, f))
    t, far = tl.maximum(first, near), tl.minimum(tl.minimum(tl.maximum(a, d), tl.maximum(b, e)), tl.maximum(c, f))
    x = cell_at(ox + t * dx, 0, 1 << DEPTH, 2.0**DEPTH)
    y = cell_at(oy + t * dy, 0, 1 << DEPTH, 2.0**DEPTH)
    z = cell_at(oz + t * dz, 0, 1 << DEPTH, 2.0**DEPTH)
    return ((ox, oy, oz), (dx, dy, dz), (ix, iy, iz)), t, here & (t < far), (x, y, z)


@triton.jit
def leaf(cells, x, y, z, going, DEPTH: tl.constexpr):
    """Value of the leaf at a cell, and the logarithm of its side."""
    node = tl.zeros_like(x)
    value = tl.zeros_like(x)
    shift = tl.zeros_like(x) + DEPTH
    divided = going
    for level in range(DEPTH):
        s = DEPTH - 1 - level
        octant = 4 * ((x >> s) & 1) + 2 * ((y >> s) & 1) + ((z >> s) & 1)
        value = tl.where(divided, tl.load(cells + 8 * node + octant, mask=divided, other=0), value)
        shift = tl.where(divided, s, shift)
        divided = divided & (value > 0)
        node = tl.where(divided, value, node)
    return value, shift


@triton.jit
def leave(x, y, z, shift, ray, t, DEPTH: tl.constexpr):
    """Distances at which rays leave their cells of side 2^shift, and the cells after them."""
    ox, oy, oz = ray[0]
    dx, dy, dz = ray[1]
    ix, iy, iz = ray[2]
    side = 2.0**DEPTH
    size = 1 << shift
    lx, ly, lz = (x >> shift) << shift, (y >> shift) << shift, (z >> shift) << shift
    hx = lx + size
    hy = ly + size
    hz = lz + size
    tx = (tl.where(ix > 0, hx, lx).to(tl.float32) / side - ox) * ix
    ty = (tl.where(iy > 0, hy, ly).to(tl.float32) / side - oy) * iy
    tz = (tl.where(iz > 0, hz, lz).to(tl.float32) / side - oz) * iz
    end = tl.maximum(tl.minimum(tl.minimum(tx, ty), tz), t)
    through_x = (tx <= ty) & (tx <= tz)
    through_y = (ty <= tz) & ~through_x
    u = tl.where(through_x, tl.where(ix > 0, hx, lx - 1), cell_at(ox + end * dx, lx, hx, side))
    v = tl.where(through_y, tl.where(iy > 0, hy, ly - 1), cell_at(oy + end * dy, ly, hy, side))
    beyond = tl.where(iz > 0, hz, lz - 1)
    w = tl.where(through_x | through_y, cell_at(oz + end * dz, lz, hz, side), beyond)
    return end, u, v, w


@triton.jit
def inside(u, v, w, DEPTH: tl.constexpr):
    """True inside the cube."""
    side = 1 << DEPTH
    return (u >= 0) & (v >= 0) & (w >= 0) & (u < side) & (v < side) & (w < side)


@triton.jit
def row_in(named, value, going):
    """Table row for a value of `Tree.cells`, -1 for none."""
    there = going & (value < 0)
    return tl.load(named + tl.where(there, -1 - value, 0), mask=there, other=-1)


@triton.jit(do_not_specialize=["R", "near", "most"])
def _walk(
    rays, cells, named, density, counts, ray_starts, out, R, near, most, DEPTH: tl.constexpr, WRITE: tl.constexpr
):
    origins, directions = rays
    t_start, t_end, rows = out
    r, here = indices(R, BLOCK)
    ray, t, going, cell = enter(origins, directions, r, here, near, DEPTH)
    x, y, z = cell
    count = tl.zeros([BLOCK], tl.int32)
    thickness = tl.zeros([BLOCK], tl.float32)
    if WRITE:
        first = tl.load(ray_starts + r, mask=here, other=0)
    while tl.max(going.to(tl.int32), 0) > 0:
        value, shift = leaf(cells, x, y, z, going, DEPTH)
        end, u, v, w = leave(x, y, z, shift, ray, t, DEPTH)
        row = row_in(named, value, going)
        held = row >= 0
        if WRITE:
            place = first + count
            tl.store(t_start + place, t, mask=held)
            tl.store(t_end + place, end, mask=held)
            tl.store(rows + place, row.to(tl.int64), mask=held)
        count += held.to(tl.int32)
        thickness += tl.load(density + row, mask=held, other=0.0) * tl.where(held, end - t, 0.0)
        going = going & inside(u, v, w, DEPTH) & (thickness <= most)
        x, y, z, t = tl.where(going, u, 0), tl.where(going, v, 0), tl.where(going, w, 0), end
    if not WRITE:
        tl.store(counts + r, count, mask=here)


@torch.no_grad()
def run(origins, directions, tree, density, near, stop):
    count, device = len(origins), origins.device
    rays = origins.contiguous(), directions.contiguous()
    given = rays, *(x.contiguous() for x in (tree.cells, tree.named, density))
    numbers = count, float(near), -math.log(stop) if stop > 0 else math.inf
    options = {"DEPTH": tree.depth, "num_warps": 1, "enable_fp_fusion": False}  # both passes round alike
    counts = torch.zeros(count, dtype=torch.int32, device=device)
    ray_starts = torch.zeros(count + 1, dtype=torch.int64, device=device)
    grid, out = (blocks(count, BLOCK),), (density, density, ray_starts)  # nothing is written into these
    launch(_walk, grid, *given, counts, ray_starts, out, *numbers, WRITE=False, **options)
    torch.cumsum(counts, 0, out=ray_starts[1:])
    total = int(ray_starts[-1])
    out = empty(total, device=device), empty(total, device=device), torch.empty(total, dtype=torch.int64, device=device)
    launch(_walk, grid, *given, counts, ray_starts, out, *numbers, WRITE=True, **options)
    return *out[:2], ray_starts, out[2]
