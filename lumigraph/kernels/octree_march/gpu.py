"""Triton: one lane takes one ray, forward and on the way back. Gradients of the rows meet in atomic adds."""

import torch
import triton
import triton.language as tl

from .._gpu import blocks, indices, launch, load_row, store_row
from .._operation import differentiable, empty
from ..octree_cells.gpu import enter, inside, leaf, leave, row_in
from ..spherical_harmonics.gpu import harmonic

BLOCK = tl.constexpr(32)  # rays


@triton.jit
def _colour(harmonics, row, occupied, direction, BASIS: tl.constexpr):
    """Colours of cells along directions."""
    x, y, z = direction
    red, green, blue = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    for k in tl.static_range(BASIS):
        basis = harmonic(k, x, y, z)
        at = harmonics + row * (3 * BASIS) + 3 * k
        red += basis * tl.load(at, mask=occupied, other=0.0)
        green += basis * tl.load(at + 1, mask=occupied, other=0.0)
        blue += basis * tl.load(at + 2, mask=occupied, other=0.0)
    return tl.sigmoid(red), tl.sigmoid(green), tl.sigmoid(blue)


@triton.jit(do_not_specialize=["R", "near", "stop"])
def _forward(rays, cells, named, density, harmonics, outputs, R, near, stop, DEPTH: tl.constexpr, BASIS: tl.constexpr):
    origins, directions = rays
    rgb, distance, opacity = outputs
    r, here = indices(R, BLOCK)
    ray, t, going, cell = enter(origins, directions, r, here, near, DEPTH)
    x, y, z = cell
    red = tl.zeros([BLOCK], tl.float32)
    green = tl.zeros([BLOCK], tl.float32)
    blue = tl.zeros([BLOCK], tl.float32)
    sum_wt = tl.zeros([BLOCK], tl.float32)
    sum_w = tl.zeros([BLOCK], tl.float32)
    transmittance = tl.zeros([BLOCK], tl.float32) + 1.0
    while tl.max(going.to(tl.int32), 0) > 0:
        value, shift = leaf(cells, x, y, z, going, DEPTH)
        end, u, v, w = leave(x, y, z, shift, ray, t, DEPTH)
        row = row_in(named, value, going).to(tl.int64)
        occupied = row >= 0
        exp_tau = tl.exp(-tl.load(density + row, mask=occupied, other=0.0) * tl.where(occupied, end - t, 0.0))
        weight = transmittance * (1 - exp_tau)
        transmittance *= exp_tau
        r_, g_, b_ = _colour(harmonics, row, occupied, ray[1], BASIS)
        red += weight * r_
        green += weight * g_
        blue += weight * b_
        sum_wt += weight * tl.where(occupied, 0.5 * (t + end), 0.0)
        sum_w += weight
        going = going & inside(u, v, w, DEPTH) & (transmittance >= stop)
        x, y, z, t = tl.where(going, u, 0), tl.where(going, v, 0), tl.where(going, w, 0), end
    store_row(rgb, r, (red, green, blue), here)
    tl.store(distance + r, sum_wt, mask=here)
    tl.store(opacity + r, sum_w, mask=here)


@triton.jit(do_not_specialize=["R", "near", "stop"])
def _backward(
    grads, rays, cells, named, density, harmonics, outputs, found, R, near, stop,
    DEPTH: tl.constexpr, BASIS: tl.constexpr,
):  # fmt: skip
    """Gradients: dL/dtau_i = g_i T_{i+1} - sum_{j>i} g_j w_j with g_i = dL/dw_i."""
    origins, directions = rays
    d_rgb, d_distance, d_opacity = grads
    rgb, distance, opacity = outputs
    to_density, to_harmonics = found
    r, here = indices(R, BLOCK)
    ray, t, going, cell = enter(origins, directions, r, here, near, DEPTH)
    x, y, z = cell
    dx, dy, dz = ray[1]
    g_red, g_green, g_blue = load_row(d_rgb, r, here)
    g_distance = tl.load(d_distance + r, mask=here, other=0.0)
    g_opacity = tl.load(d_opacity + r, mask=here, other=0.0)
    sum_gw = g_distance * tl.load(distance + r, mask=here, other=0.0)
    sum_gw += g_opacity * tl.load(opacity + r, mask=here, other=0.0)
    sum_gw += g_red * tl.load(rgb + 3 * r, mask=here, other=0.0)
    sum_gw += g_green * tl.load(rgb + 3 * r + 1, mask=here, other=0.0)
    sum_gw += g_blue * tl.load(rgb + 3 * r + 2, mask=here, other=0.0)
    transmittance = tl.zeros([BLOCK], tl.float32) + 1.0
    while tl.max(going.to(tl.int32), 0) > 0:
        value, shift = leaf(cells, x, y, z, going, DEPTH)
        end, u, v, w = leave(x, y, z, shift, ray, t, DEPTH)
        row = row_in(named, value, going).to(tl.int64)
        occupied = row >= 0
        length = tl.where(occupied, end - t, 0.0)
        exp_tau = tl.exp(-tl.load(density + row, mask=occupied, other=0.0) * length)
        weight = transmittance * (1 - exp_tau)
        transmittance *= exp_tau
        red, green, blue = _colour(harmonics, row, occupied, ray[1], BASIS)
        g = g_opacity + g_distance * (0.5 * (t + end)) + g_red * red + g_green * green + g_blue * blue
        sum_gw -= tl.where(occupied, g * weight, 0.0)
        slope = (g * transmittance - sum_gw) * length
        tl.atomic_add(to_density + row, slope, mask=occupied, sem="relaxed")
        g_r = weight * g_red * red * (1 - red)
        g_g = weight * g_green * green * (1 - green)
        g_b = weight * g_blue * blue * (1 - blue)
        for k in tl.static_range(BASIS):
            basis = harmonic(k, dx, dy, dz)
            at = to_harmonics + row * (3 * BASIS) + 3 * k
            tl.atomic_add(at, basis * g_r, mask=occupied, sem="relaxed")
            tl.atomic_add(at + 1, basis * g_g, mask=occupied, sem="relaxed")
            tl.atomic_add(at + 2, basis * g_b, mask=occupied, sem="relaxed")
        going = going & inside(u, v, w, DEPTH) & (transmittance >= stop)
        x, y, z, t = tl.where(going, u, 0), tl.where(going, v, 0), tl.where(going, w, 0), end


def forward(ctx, origins, directions, tree, density, harmonics, near, stop):
    rays, device = len(origins), origins.device
    out = empty(rays, 3, device=device), empty(rays, device=device), empty(rays, device=device)
    ctx.grid, ctx.numbers = (blocks(rays, BLOCK),), (rays, float(near), float(stop))
    ctx.sizes = {"DEPTH": tree.depth, "BASIS": harmonics.shape[1], "num_warps": 1}
    ctx.tree = tree.cells.contiguous(), tree.named
    given = (origins, directions), *ctx.tree, density, harmonics, out
    launch(_forward, ctx.grid, *given, *ctx.numbers, **ctx.sizes)
    ctx.save_for_backward(origins, directions, density, harmonics, *out)
    return out


def backward(ctx, *grads):
    origins, directions, density, harmonics, *out = ctx.saved_tensors
    found = torch.zeros_like(density), torch.zeros_like(harmonics)
    given = grads, (origins, directions), *ctx.tree, density, harmonics, tuple(out), found
    launch(_backward, ctx.grid, *given, *ctx.numbers, **ctx.sizes)
    return None, None, None, *found, None, None


run = differentiable(forward, backward)
