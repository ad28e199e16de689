"""Numba: a ray traverses the tree once forward and once backward. Gradients of each cell from each ray are stored,
sorted by cells, and summed by one thread for each run of cells, so that no two add to one place."""

import math

import numpy as np
import torch
from numba import get_num_threads, njit, prange

from .._operation import differentiable, empty
from ..octree_cells.cpu import CHUNK, FAST, ONE, ZERO, cross, in_cells, outside, place_at, shared, through_cube
from ..spherical_harmonics.cpu import basis

HALF = np.float32(0.5)
CELLS_PER_CHUNK = 64  # cells of a ray whose colours are worked out together


def spread(rays):
    """Order of chunks of rays that balances threads: each thread's run has chunks from all over a picture, and at any
    time all threads work near each other."""
    threads, chunks = get_num_threads(), np.arange((rays + CHUNK - 1) // CHUNK)
    return np.concatenate([chunks[i::threads] for i in range(threads)])


@njit(inline="always")
def _colour(harmonics, row, y):
    """Colour of a cell in the direction whose basis is y."""
    red = green = blue = ZERO
    for k in range(harmonics.shape[1]):
        red += y[k] * harmonics[row, k, 0]
        green += y[k] * harmonics[row, k, 1]
        blue += y[k] * harmonics[row, k, 2]
    return ONE / (ONE + np.exp(-red)), ONE / (ONE + np.exp(-green)), ONE / (ONE + np.exp(-blue))


@njit(inline="always")
def _sum_colours(chunk_rows, weights, count, harmonics, y, prefetched):
    """Weighted sums of cells' colours. All rows are prefetched first, so that memory latencies overlap."""
    last = harmonics.shape[1] - 1
    for i in range(count):
        prefetched[0] += (
            harmonics[chunk_rows[i], 0, 0] + harmonics[chunk_rows[i], last // 2, 0] + harmonics[chunk_rows[i], last, 2]
        )
    red = green = blue = ZERO
    for i in range(count):
        r_, g_, b_ = _colour(harmonics, chunk_rows[i], y)
        red += weights[i] * r_
        green += weights[i] * g_
        blue += weights[i] * b_
    return red, green, blue


@njit(parallel=True, fastmath=True, **FAST)
def _forward(chunks, o, d, cells, named, density, harmonics, bands, depth, near, stop, rgb, distance, opacity, counts):
    n, side = len(o), np.int64(1) << depth
    across = np.float32(side)
    for i in prange(len(chunks)):
        chunk = chunks[i]
        path, y = np.zeros(depth + 1, np.int64), np.zeros(16, np.float32)
        chunk_rows, weights = np.zeros(CELLS_PER_CHUNK, np.int64), np.zeros(CELLS_PER_CHUNK, np.float32)
        prefetched = np.zeros(1, np.float32)  # a sum that nobody needs, or compilers would leave it out
        for r in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            ray = in_cells(o, d, r, across)
            t, far = through_cube(ray, across, near)
            red = green = blue = sum_wt = sum_w = ZERO
            transmittance, count, level, chunk_count = ONE, np.int64(0), np.int64(0), 0
            if t < far:
                basis(d[r, 0], d[r, 1], d[r, 2], bands, y)
                u, v, w = place_at(ray, t, side)
                while True:
                    row, level, end, u2, v2, w2 = cross(cells, named, path, level, depth, u, v, w, ray, t)
                    if row >= 0:
                        count += 1
                        exp_tau = np.exp(-density[row] * (end - t))
                        weight = transmittance * (ONE - exp_tau)
                        transmittance *= exp_tau
                        sum_wt += weight * HALF * (t + end)
                        sum_w += weight
                        chunk_rows[chunk_count], weights[chunk_count] = row, weight
                        chunk_count += weight > ZERO
                        if chunk_count == CELLS_PER_CHUNK:
                            r_, g_, b_ = _sum_colours(chunk_rows, weights, chunk_count, harmonics, y, prefetched)
                            red, green, blue, chunk_count = red + r_, green + g_, blue + b_, 0
                    if outside(u2, v2, w2, side) or transmittance < stop:
                        break
                    level = shared(level - 1, depth, (u ^ u2) | (v ^ v2) | (w ^ w2))
                    u, v, w, t = u2, v2, w2, end
                if chunk_count:
                    r_, g_, b_ = _sum_colours(chunk_rows, weights, chunk_count, harmonics, y, prefetched)
                    red, green, blue = red + r_, green + g_, blue + b_
            rgb[r, 0], rgb[r, 1], rgb[r, 2] = red, green, blue
            distance[r], opacity[r], counts[r] = sum_wt, sum_w, count


@njit(parallel=True, fastmath=True, **FAST)
def _share(
    chunks, g_rgb, g_distance, g_opacity, o, d, cells, named, density, harmonics, bands, depth, near,
    rgb, distance, opacity, starts, bases, rows, rays, shares,
):  # fmt: skip
    """Row, density gradient and three harmonics gradients of each cell that each ray crosses.

    dL/dtau_i = g_i T_{i+1} - sum_{j>i} g_j w_j with g_i = dL/dw_i; the sum over all of a ray is known from its outputs.
    """
    n, side = len(o), np.int64(1) << depth
    across = np.float32(side)
    for j in prange(len(chunks)):
        chunk = chunks[j]
        path = np.zeros(depth + 1, np.int64)
        for r in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            if starts[r] == starts[r + 1]:
                continue
            ray = in_cells(o, d, r, across)
            t, _ = through_cube(ray, across, near)
            y = bases[r]
            basis(d[r, 0], d[r, 1], d[r, 2], bands, y)
            sum_gw = g_distance[r] * distance[r] + g_opacity[r] * opacity[r]
            for c in range(3):
                sum_gw += g_rgb[r, c] * rgb[r, c]
            transmittance, i, level = ONE, starts[r], np.int64(0)
            u, v, w = place_at(ray, t, side)
            while True:
                row, level, end, u2, v2, w2 = cross(cells, named, path, level, depth, u, v, w, ray, t)
                if row >= 0:
                    length = end - t
                    exp_tau = np.exp(-density[row] * length)
                    weight = transmittance * (ONE - exp_tau)
                    transmittance *= exp_tau
                    g = g_opacity[r] + g_distance[r] * HALF * (t + end)
                    colours = _colour(harmonics, row, y)
                    for c in range(3):
                        colour = colours[c]
                        g += g_rgb[r, c] * colour
                        shares[i, 1 + c] = weight * g_rgb[r, c] * colour * (ONE - colour)
                    sum_gw -= g * weight
                    shares[i, 0] = (g * transmittance - sum_gw) * length
                    rows[i], rays[i] = row, r
                    i += 1
                    if i == starts[r + 1]:
                        break
                level = shared(level - 1, depth, (u ^ u2) | (v ^ v2) | (w ^ w2))
                u, v, w, t = u2, v2, w2, end


@njit(cache=True)
def _sorted(rows, firsts, order):
    """Counting sort: start of each row's shares, and their indices, in order of rays."""
    for i in range(len(rows)):
        firsts[rows[i] + 1] += 1
    for row in range(len(firsts) - 1):
        firsts[row + 1] += firsts[row]
    for i in range(len(rows)):
        row = rows[i]
        order[firsts[row]] = i
        firsts[row] += 1
    for row in range(len(firsts) - 1, 0, -1):
        firsts[row] = firsts[row - 1]
    firsts[0] = 0


@njit(parallel=True, fastmath=True, **FAST)
def _sum(firsts, order, rays, shares, bases, to_density, to_harmonics):
    for row in prange(len(to_density)):
        for j in range(firsts[row], firsts[row + 1]):
            i = order[j]
            r = rays[i]
            to_density[row] += shares[i, 0]
            for k in range(to_harmonics.shape[1]):
                for c in range(3):
                    to_harmonics[row, k, c] += bases[r, k] * shares[i, 1 + c]


def forward(ctx, origins, directions, tree, density, harmonics, near, stop):
    n = len(origins)
    rgb, distance, opacity = empty(n, 3), empty(n), empty(n)
    starts = torch.zeros(n + 1, dtype=torch.int64)
    ctx.numbers = math.isqrt(harmonics.shape[1]), tree.depth, np.float32(near)
    ctx.tree = tree.cells.numpy(), tree.rows.numpy()
    rays = origins.detach().numpy(), directions.detach().numpy()
    tables = density.detach().numpy(), harmonics.detach().numpy()
    out = rgb.numpy(), distance.numpy(), opacity.numpy(), starts.numpy()[1:]
    _forward(spread(n), *rays, *ctx.tree, *tables, *ctx.numbers, np.float32(stop), *out)
    ctx.save_for_backward(origins, directions, density, harmonics, rgb, distance, opacity, starts.cumsum_(0))
    return rgb, distance, opacity


def backward(ctx, *grads):
    origins, directions, density, harmonics, *outputs = (x.detach().numpy() for x in ctx.saved_tensors)
    starts = outputs[-1]
    bases = np.zeros((len(origins), 16), np.float32)
    rows, rays, order = (np.empty(starts[-1], np.int32) for _ in range(3))
    shares = empty(int(starts[-1]), 4).numpy()
    given = origins, directions, *ctx.tree, density, harmonics, *ctx.numbers, *outputs
    _share(spread(len(origins)), *(g.numpy() for g in grads), *given, bases, rows, rays, shares)
    firsts = np.zeros(len(density) + 1, np.int64)
    _sorted(rows, firsts, order)
    to_density, to_harmonics = torch.zeros(density.shape), torch.zeros(harmonics.shape)
    _sum(firsts, order, rays, shares, bases, to_density.numpy(), to_harmonics.numpy())
    return None, None, None, to_density, to_harmonics, None, None


run = differentiable(forward, backward)
