"""Triton: one program takes one ray, all its bins at once, and then a few edges at a time."""

import torch
import triton
import triton.language as tl

from .._gpu import launch
from .._operation import empty
from ..contract.gpu import scale_of, stretch_of

EDGES = tl.constexpr(16)


@triton.jit
def _axis(x, size):
    """Along one axis of corners that span [-1, 1]: the corner below each coordinate, and the fraction to the next."""
    s = tl.minimum(tl.maximum((x + 1.0) * (0.5 * (size - 1).to(tl.float32)), 0.0), (size - 1).to(tl.float32))
    corner = tl.minimum(tl.maximum(s.to(tl.int32), 0), size - 2)
    return corner, s - corner.to(tl.float32)


@triton.jit
def _interpolated(values, X, Y, Z, x, y, z, here):
    i, a = _axis(x, X)  # one pair a line: Triton 3.6 assigns to no nested tuple
    j, b = _axis(y, Y)
    k, c = _axis(z, Z)
    total = tl.zeros_like(x)
    for corner in tl.static_range(8):
        di, dj, dk = corner // 4, corner // 2 % 2, corner % 2
        weight = (a if di else 1 - a) * (b if dj else 1 - b) * (c if dk else 1 - c)
        total += weight * tl.load(values + ((i + di) * Y + j + dj) * Z + k + dk, mask=here, other=0.0)
    return total


@triton.jit
def _distance(share, near, far, first, last, FORWARD: tl.constexpr):
    """Distance at s between near (0) and far (1). first, last: depths of the ends in a frustum, else their s"""
    s = first + share * (last - first)
    t = tl.where(s < 1, s, 1 / tl.maximum(2 - s, 1e-6))
    if FORWARD:
        t = near + (far - near) * (share * first / (share * first + (1 - share) * last))
    return t


@triton.jit(do_not_specialize=["X", "Y", "Z", "bins", "samples"])
def _sample(rays, values, edges, X, Y, Z, frustum, bins, samples, limits, FORWARD: tl.constexpr, BINS: tl.constexpr):
    origins, directions, near, far = rays
    scale_x, scale_y, plane, factor = frustum
    sharpness, uniform_share, min_weight, max_log_density = limits
    r = tl.program_id(0).to(tl.int64)
    i = tl.arange(0, BINS)
    here = i < bins
    oz, dz = tl.load(origins + 3 * r + 2), tl.load(directions + 3 * r + 2)
    a, b = tl.load(near + r), tl.load(far + r)
    first, last = tl.minimum(a, 2 - 1 / tl.maximum(a, 1.0)), tl.minimum(b, 2 - 1 / tl.maximum(b, 1.0))
    if FORWARD:
        first, last = tl.maximum(oz + a * dz, plane), tl.maximum(oz + b * dz, plane)
    t_start = _distance(i.to(tl.float32) / bins, a, b, first, last, FORWARD)
    t_end = _distance((i + 1).to(tl.float32) / bins, a, b, first, last, FORWARD)
    t = 0.5 * (t_start + t_end)
    x = tl.load(origins + 3 * r) + t * tl.load(directions + 3 * r)
    y = tl.load(origins + 3 * r + 1) + t * tl.load(directions + 3 * r + 1)
    z = oz + t * dz
    if FORWARD:
        inverse = 1 / tl.maximum(z, plane)
        stretch = factor * tl.exp2(tl.log2(inverse) * (4.0 / 3.0))
        x, y, z = scale_x * x * inverse, scale_y * y * inverse, 1 - 2 * plane * inverse
    else:
        inverse, across = scale_of(x, y, z)
        stretch = stretch_of(inverse, across)
        x, y, z = across * x, across * y, across * z
    log_density = tl.minimum(_interpolated(values, X, Y, Z, x, y, z, here), max_log_density)
    tau = tl.where(here, tl.exp(log_density) * stretch * (t_end - t_start), 0.0)
    tau = tl.minimum(tau, 32.0)  # e^-32 is nothing, and a sum without larger terms keeps its digits

    weight = tl.exp(tau - tl.cumsum(tau, 0)) * (1 - tl.exp(-tau))
    weight = tl.where(here, tl.exp2(sharpness * tl.log2(tl.maximum(weight, 1e-37))), 0.0)
    total = tl.sum(weight, 0)
    least = uniform_share / bins * total + min_weight
    whole = total + bins * least
    weight = tl.where(here, weight + least, 0.0)
    below = tl.cumsum(weight, 0) - weight
    per_weight = tl.where(here, 1 / tl.where(here, weight, 1.0), 0.0)

    for j0 in range(0, samples + 1, EDGES):
        j = j0 + tl.arange(0, EDGES)
        share = whole * (j.to(tl.float32) / samples)
        # Bins wholly below the share count as one each, the bin that holds it as a part of one.
        filled = tl.minimum(tl.maximum((share[:, None] - below[None, :]) * per_weight[None, :], 0.0), 1.0)
        place = tl.sum(filled, 1) / bins
        tl.store(edges + r * (samples + 1) + j, _distance(place, a, b, first, last, FORWARD), mask=j <= samples)


@torch.no_grad()
def run(origins, directions, near, far, log_density, resampling, frustum):
    r, (scale_x, scale_y, plane) = resampling, frustum or (1.0, 1.0, 1.0)
    edges = empty(len(origins), r.samples + 1, device=origins.device)
    rays = tuple(x.contiguous() for x in (origins, directions, near, far))
    numbers = *log_density.shape, (scale_x, scale_y, plane, (2 * scale_x * scale_y * plane) ** (1 / 3))
    limits = r.sharpness, r.uniform_share, r.min_weight, r.max_log_density
    BINS = triton.next_power_of_2(r.bins)
    options = {"FORWARD": frustum is not None, "BINS": BINS, "num_warps": max(1, min(8, BINS // 128))}
    given = rays, log_density.contiguous(), edges, *numbers, r.bins, r.samples, limits
    launch(_sample, (len(origins),), *given, **options)
    return edges
