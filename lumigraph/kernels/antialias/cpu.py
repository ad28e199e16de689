"""Numba: threads share the rows. Each pixel follows the surface to its right and lower neighbours, then blends over the
four pairs that it belongs to. One thread sums the gradients of the few silhouette edges."""

import numpy as np
import torch
from numba import njit, prange

from .._operation import differentiable, empty
from ..rasterize_mesh.cpu import FAST, _adjugate
from . import MAX_FACES


@njit(**FAST)
def _row(planes, k):
    return planes[0] if k == 0 else planes[1] if k == 1 else planes[2]


@njit(**FAST)
def _silhouette(f, x, y, dx, dy, corners, faces, neighbours):
    """Silhouette edge 3 f + k where the surface of f, seen at (x, y), ends before (x + dx, y + dy); -1 for none."""
    for _ in range(MAX_FACES):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if min(corners[a, 2], corners[b, 2], corners[c, 2]) <= 0:
            return -1
        first, second, third, volume = _adjugate(corners, a, b, c)
        planes, sign = (first, second, third), -1.0 if volume < 0 else 1.0
        edge, nearest = -1, np.inf
        for k in range(3):
            plane = _row(planes, k)
            slope = (plane[0] * dx + plane[1] * dy) * sign
            here = (plane[0] * x + plane[1] * y + plane[2]) * sign
            if slope < 0 and here + slope < 0 and here / -slope < nearest:
                edge, nearest = k, here / -slope
        if edge < 0:
            return -1
        beyond = neighbours[f, edge]
        if beyond < 0:
            return 3 * f + edge
        i, j = faces[f, (edge + 1) % 3], faces[f, (edge + 2) % 3]
        v = faces[beyond, 0] + faces[beyond, 1] + faces[beyond, 2] - i - j
        plane = _row(planes, edge)
        side = (plane[0] * corners[v, 0] + plane[1] * corners[v, 1] + plane[2] * corners[v, 2]) * sign
        if side > 0 and corners[v, 2] > 0:
            return 3 * f + edge
        f = beyond
    return -1


@njit(**FAST)
def _crossing(edge, row, column, axis, corners, faces):
    """Crossing of an edge with the line through the centres of a pixel and its neighbour along an axis: distance from
    the middle between them, position along the edge in [0, 1], the edge's slope, and whether it is steep enough to
    count."""
    f, k = edge // 3, edge % 3
    i, j = faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
    other = 1 - axis
    a, b = np.float64(corners[i, axis]) / corners[i, 2], np.float64(corners[j, axis]) / corners[j, 2]
    c, d = np.float64(corners[i, other]) / corners[i, 2], np.float64(corners[j, other]) / corners[j, 2]
    if abs(a - b) > abs(c - d) or c == d:
        return 0.0, 0.0, 0.0, False
    along, across = (row, column) if axis else (column, row)
    share, slope = (across + 0.5 - c) / (d - c), (b - a) / (d - c)
    return min(max(a + share * (b - a) - along - 1.0, -0.5), 0.5), share, slope, True


@njit(parallel=True, **FAST)
def _find(depth, found, corners, faces, neighbours, edges, shifts):
    """Edge and s for each pixel with its right neighbour and with its lower one; -1 and 0 for none."""
    height, width = found.shape
    for number in prange(height):
        row = np.int64(number)  # or Numba makes floating-point numbers of its sums
        for column in range(width):
            for axis in range(2):
                dx, dy = 1 - axis, axis
                edges[row, column, axis], shifts[row, column, axis] = -1, 0
                if column + dx >= width or row + dy >= height:
                    continue
                f, g = found[row, column], found[row + dy, column + dx]
                if f == g:
                    continue
                x, y = column + 0.5, row + 0.5
                if g < 0 or (f >= 0 and depth[row, column] <= depth[row + dy, column + dx]):
                    edge = _silhouette(f, x, y, dx, dy, corners, faces, neighbours)
                else:
                    edge = _silhouette(g, x + dx, y + dy, -dx, -dy, corners, faces, neighbours)
                if edge >= 0:
                    s, _, _, counts = _crossing(edge, row, column, axis, corners, faces)
                    if counts:
                        edges[row, column, axis], shifts[row, column, axis] = edge, s


@njit(parallel=True, **FAST)
def _blend(picture, shifts, out):
    height, width, channels = picture.shape
    for number in prange(height):
        row = np.int64(number)  # or Numba makes floating-point numbers of its sums
        for column in range(width):
            for k in range(channels):
                out[row, column, k] = picture[row, column, k]
            for axis in range(2):
                y, x, s = row + axis, column + 1 - axis, shifts[row, column, axis]
                if s < 0:
                    for k in range(channels):
                        out[row, column, k] += s * (picture[row, column, k] - picture[y, x, k])
                y, x = row - axis, column - 1 + axis
                if y >= 0 and x >= 0 and shifts[y, x, axis] > 0:
                    for k in range(channels):
                        out[row, column, k] += shifts[y, x, axis] * (picture[y, x, k] - picture[row, column, k])


@njit(parallel=True, **FAST)
def _to_picture(grad, picture, edges, shifts, out, to_shifts):
    """Gradients of the picture and of each pair's s."""
    height, width, channels = picture.shape
    for number in prange(height):
        row = np.int64(number)  # or Numba makes floating-point numbers of its sums
        for column in range(width):
            for k in range(channels):
                out[row, column, k] = grad[row, column, k]
            for axis in range(2):
                y, x, s = row + axis, column + 1 - axis, shifts[row, column, axis]
                to_shifts[row, column, axis] = 0
                if edges[row, column, axis] >= 0:
                    r, q = (y, x) if s > 0 else (row, column)  # the pixel that is changed
                    for k in range(channels):
                        to_shifts[row, column, axis] += grad[r, q, k] * (picture[row, column, k] - picture[y, x, k])
                        out[row, column, k] += s * grad[r, q, k]
                y, x = row - axis, column - 1 + axis
                if y >= 0 and x >= 0 and edges[y, x, axis] >= 0:
                    s = shifts[y, x, axis]
                    r, q = (row, column) if s > 0 else (y, x)
                    for k in range(channels):
                        out[row, column, k] -= s * grad[r, q, k]


@njit(**FAST)
def _to_corners(to_shifts, edges, corners, faces, out):
    """Gradient of vertices: ds = (1 - share, share) times movement along the axis, less slope times that across."""
    height, width, _ = edges.shape
    out[:] = 0
    for row in range(height):
        for column in range(width):
            for axis in range(2):
                edge = edges[row, column, axis]
                if edge < 0:
                    continue
                _, share, slope, _ = _crossing(edge, row, column, axis, corners, faces)
                for n in range(1, 3):
                    v = faces[edge // 3, (edge % 3 + n) % 3]
                    g = to_shifts[row, column, axis] * (share if n == 2 else 1 - share) / corners[v, 2]
                    along, across = corners[v, axis] / corners[v, 2], corners[v, 1 - axis] / corners[v, 2]
                    out[v, axis] += g
                    out[v, 1 - axis] -= g * slope
                    out[v, 2] -= g * (along - slope * across)


def forward(ctx, picture, depth, found, corners, faces, neighbours):
    height, width, _ = picture.shape
    edges, shifts = torch.empty(height, width, 2, dtype=torch.int32), empty(height, width, 2)
    given = (x.detach().numpy() for x in (depth, found, corners, faces, neighbours))
    _find(*given, edges.numpy(), shifts.numpy())
    out = empty(*picture.shape)
    _blend(picture.detach().numpy(), shifts.numpy(), out.numpy())
    ctx.save_for_backward(picture, edges, shifts, corners, faces)
    return out


def backward(ctx, grad):
    picture, edges, shifts, corners, faces = (x.detach().numpy() for x in ctx.saved_tensors)
    to_picture, to_shifts = empty(*picture.shape), np.empty_like(shifts)
    to_corners = np.zeros(corners.shape)
    _to_picture(grad.numpy(), picture, edges, shifts, to_picture.numpy(), to_shifts)
    _to_corners(to_shifts, edges, corners, faces, to_corners)
    return to_picture, None, None, torch.from_numpy(to_corners.astype(np.float32)), None, None


run = differentiable(forward, backward)
