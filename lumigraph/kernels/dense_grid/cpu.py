"""Numba. Forward, threads share the points. For gradients they share slabs of the grid: each goes through all points
and adds to the corners of its own planes, so that no two threads add to one corner and every corner's sum has the order
of the points, for any number of threads."""

import numpy as np
import torch
from numba import get_num_threads, njit, prange

from .._lanes import ahead
from .._operation import differentiable, empty
from ..hash_encode.cpu import BLOCK, blend, spread

FAST = {"fastmath": True, "cache": True, "error_model": "numpy"}
ZERO, ONE = np.float32(0), np.float32(1)


@njit(inline="always")
def _axis(x, low, scale, size):
    """Along one axis: the corner at or below a coordinate, and the fraction towards the next; clamped."""
    s = min(max((x - low) * scale, ZERO), np.float32(size - 1))
    corner = max(min(np.int32(s), np.int32(size - 2)), np.int32(0))  # the last also where x is no number
    return corner, s - np.float32(corner)


@njit(**FAST)
def _sides(y, z, box, shape):
    """Offsets and weights of the four corners around a point within a plane of x."""
    cy, fy = _axis(y, box[0, 1], box[1, 1], shape[1])
    cz, fz = _axis(z, box[0, 2], box[1, 2], shape[2])
    across = np.uint32(shape[2]) * np.uint32(shape[3])
    first = np.uint32(cy) * across + np.uint32(cz) * np.uint32(shape[3])
    entries = first, first + across, first + np.uint32(shape[3]), first + across + np.uint32(shape[3])
    return entries, ((ONE - fy) * (ONE - fz), fy * (ONE - fz), (ONE - fy) * fz, fy * fz)


@njit(parallel=True, **FAST)
def _look_up(points, grid, box, shape, lanes, out):
    n = len(points)
    plane = np.uint32(shape[1]) * np.uint32(shape[2]) * np.uint32(shape[3])
    for block in prange((n + BLOCK - 1) // BLOCK):
        entries, weights = np.empty(8 * BLOCK, np.uint32), np.empty(8 * BLOCK, np.float32)
        first = block * BLOCK
        count = min(BLOCK, n - first)
        for i in range(count):
            cx, fx = _axis(points[first + i, 0], box[0, 0], box[1, 0], shape[0])
            places, shares = _sides(points[first + i, 1], points[first + i, 2], box, shape)
            for side in range(4):
                entry = np.uint32(cx) * plane + places[side]
                entries[2 * side * BLOCK + i], entries[(2 * side + 1) * BLOCK + i] = entry, entry + plane
                weights[2 * side * BLOCK + i] = (ONE - fx) * shares[side]
                weights[(2 * side + 1) * BLOCK + i] = fx * shares[side]
                ahead(grid, entry)
                ahead(grid, entry + plane)
        for i in range(count):
            blend(grid, entries, weights, i, lanes, out, first + i, n)


@njit(parallel=True, **FAST)
def _grid_gradient(grad, points, slabs, box, shape, lanes, out):
    """Gradient of the grid. slabs: first plane of x of each thread"""
    n = len(points)
    plane = np.uint32(shape[1]) * np.uint32(shape[2]) * np.uint32(shape[3])
    for slab in prange(len(slabs) - 1):
        entries, weights = np.empty(8 * BLOCK, np.uint32), np.empty(8 * BLOCK, np.float32)
        low, high = slabs[slab], slabs[slab + 1]
        for i in range(n):
            cx, fx = _axis(points[i, 0], box[0, 0], box[1, 0], shape[0])
            below, above = low <= cx < high, low <= cx + 1 < high
            if below or above:
                places, shares = _sides(points[i, 1], points[i, 2], box, shape)
                # A plane that is another thread's is replaced by one's own, with no weight.
                here = np.uint32(cx if below else cx + 1) * plane
                there = np.uint32(cx + 1 if above else cx) * plane
                for side in range(4):
                    entries[2 * side * BLOCK], entries[(2 * side + 1) * BLOCK] = (
                        here + places[side],
                        there + places[side],
                    )
                    weights[2 * side * BLOCK] = (ONE - fx) * shares[side] if below else ZERO
                    weights[(2 * side + 1) * BLOCK] = fx * shares[side] if above else ZERO
                spread(grad, i, n, entries, weights, 0, lanes, out)


@njit(parallel=True, **FAST)
def _point_gradient(grad, points, grid, box, out):
    """Gradient of points: derivative of the interpolation along each axis."""
    nx, ny, nz, channels = grid.shape
    for i in prange(len(points)):
        cx, fx = _axis(points[i, 0], box[0, 0], box[1, 0], nx)
        cy, fy = _axis(points[i, 1], box[0, 1], box[1, 1], ny)
        cz, fz = _axis(points[i, 2], box[0, 2], box[1, 2], nz)
        dx, dy, dz = ZERO, ZERO, ZERO
        for corner in range(8):
            bx, by, bz = corner & 1, corner >> 1 & 1, corner >> 2
            value = ZERO
            for f in range(channels):
                value += grad[f, i] * grid[cx + bx, cy + by, cz + bz, f]
            wx, wy, wz = fx if bx else ONE - fx, fy if by else ONE - fy, fz if bz else ONE - fz
            dx += value * (2 * bx - 1) * wy * wz
            dy += value * (2 * by - 1) * wx * wz
            dz += value * (2 * bz - 1) * wx * wy
        inside = ZERO < (points[i, 0] - box[0, 0]) * box[1, 0] < np.float32(nx - 1)
        out[i, 0] = dx * box[1, 0] if inside else ZERO
        inside = ZERO < (points[i, 1] - box[0, 1]) * box[1, 1] < np.float32(ny - 1)
        out[i, 1] = dy * box[1, 1] if inside else ZERO
        inside = ZERO < (points[i, 2] - box[0, 2]) * box[1, 2] < np.float32(nz - 1)
        out[i, 2] = dz * box[1, 2] if inside else ZERO


@njit(cache=True)
def _slabs(points, box, planes, parts):
    """Planes of x that split the grid into parts with about as many points each. No sum depends on them."""
    counts = np.zeros(planes, np.int64)
    for i in range(len(points)):
        counts[_axis(points[i, 0], box[0, 0], box[1, 0], planes)[0]] += 1
    starts = np.zeros(parts + 1, np.int64)
    plane, seen = 0, 0
    for part in range(1, parts):
        while plane < planes and seen * parts < len(points) * part:
            seen += counts[plane]
            plane += 1
        starts[part] = plane
    starts[parts] = planes
    return starts


def forward(ctx, points, grid, box):
    points, grid = points.contiguous(), grid.contiguous()
    ctx.save_for_backward(points, grid)
    ctx.box = _scaled(box, grid).numpy()
    out = empty(grid.shape[3], len(points))
    lanes = (ONE,) * grid.shape[3]
    given = points.detach().numpy(), grid.detach().numpy().reshape(-1), ctx.box
    _look_up(*given, np.array(grid.shape), lanes, out.numpy().reshape(-1))
    return out.t()


def backward(ctx, grad):
    points, grid = (x.detach() for x in ctx.saved_tensors)
    grad = grad.t().contiguous().numpy()
    to_points = to_grid = None
    if ctx.needs_input_grad[0]:
        to_points = empty(*points.shape)
        _point_gradient(grad, points.numpy(), grid.numpy(), ctx.box, to_points.numpy())
    if ctx.needs_input_grad[1]:
        # Zeros that the system gives as they are touched: a step's samples touch a small part of a large grid.
        to_grid = torch.from_numpy(np.zeros(grid.shape, np.float32))
        slabs = _slabs(points.numpy(), ctx.box, len(grid), max(2, get_num_threads()))
        lanes = (ONE,) * grid.shape[3]
        flat = to_grid.numpy().reshape(-1)
        _grid_gradient(grad.reshape(-1), points.numpy(), slabs, ctx.box, np.array(grid.shape), lanes, flat)
    return to_points, to_grid, None


def _scaled(box, grid):
    """Lower corner of the box, and voxels per unit along each axis."""
    return torch.stack([box[0], (torch.tensor(grid.shape[:3]) - 1) / (box[1] - box[0])])


run = differentiable(forward, backward, contiguous=False)
