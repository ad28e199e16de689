"""Numba: bands of rows share the picture, and each draws its part of every triangle, row by row, into a buffer of
1 / z. Values are computed for visible triangles alone.

Backward, threads share the triangles: each finds the pixels where it is visible, so that no two threads add to one
place. A second pass adds up the corners of vertices in the order of triangles.
"""

import math

import numpy as np
import torch
from numba import get_num_threads, njit, prange

from .._operation import differentiable, empty

FAST = {"cache": True, "fastmath": {"contract", "nsz", "arcp"}, "error_model": "numpy"}
SLACK = 1e-9  # pixels by which a row of a triangle is longer, so that rounding opens no gap between neighbours
BAND_ROWS = 16  # rows of a band
PIXELS = 64  # pixels of a triangle that are summed up together
PARTS = 64  # shares of the triangles, for the threads


@njit(**FAST)
def _adjugate(corners, a, b, c):
    """Rows of M^-1 times det M, and det M, in double precision."""
    ax, ay, az = np.float64(corners[a, 0]), np.float64(corners[a, 1]), np.float64(corners[a, 2])
    bx, by, bz = np.float64(corners[b, 0]), np.float64(corners[b, 1]), np.float64(corners[b, 2])
    cx, cy, cz = np.float64(corners[c, 0]), np.float64(corners[c, 1]), np.float64(corners[c, 2])
    first = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    second = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
    third = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return first, second, third, first[0] * ax + first[1] * ay + first[2] * az


@njit(**FAST)
def _pixels(low, high, size):
    """First and last pixel whose centre lies from low to high along one axis."""
    first = np.int64(math.ceil(max(low - 0.5 - SLACK, 0.0))) if low < size + 1.0 else size
    return first, np.int64(math.floor(min(high - 0.5 + SLACK, size - 1.0)))


@njit(parallel=True, **FAST)
def _measure(corners, faces, near, size, planes, boxes):
    """M^-1 of each triangle, and its first and last column and row; an empty range for an invisible one."""
    for f in prange(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        first, second, third, volume = _adjugate(corners, a, b, c)
        boxes[f, 0], boxes[f, 1], boxes[f, 2], boxes[f, 3] = 0, -1, 0, -1
        least = min(corners[a, 2], corners[b, 2], corners[c, 2])
        if volume == 0 or not math.isfinite(volume) or max(corners[a, 2], corners[b, 2], corners[c, 2]) <= near:
            continue
        for k in range(3):
            planes[f, k], planes[f, 3 + k], planes[f, 6 + k] = first[k] / volume, second[k] / volume, third[k] / volume
        if least > near:
            for axis in range(2):
                x, y = np.float64(corners[a, axis]) / corners[a, 2], np.float64(corners[b, axis]) / corners[b, 2]
                z = np.float64(corners[c, axis]) / corners[c, 2]
                begin, end = _pixels(min(x, y, z), max(x, y, z), size[axis])
                boxes[f, 2 * axis], boxes[f, 2 * axis + 1] = begin, end
        else:
            boxes[f, 0], boxes[f, 1], boxes[f, 2], boxes[f, 3] = 0, size[0] - 1, 0, size[1] - 1


@njit(**FAST)
def _span(planes, f, y, begin, end):
    """Columns of a row at height y, between begin and end, at which u >= 0 in all three rows of M^-1."""
    low, high = begin + 0.5, end + 0.5
    for k in range(3):
        slope, rest = planes[f, 3 * k], planes[f, 3 * k + 1] * y + planes[f, 3 * k + 2]
        cut = -rest / slope
        low = max(low, cut if slope > 0 else low)
        high = min(high, cut if slope < 0 else high)
        high = min(high, begin - 1.0 if slope == 0 and rest < 0 else high)
    first = math.ceil(min(low, end + 2.0) - 0.5 - SLACK)  # a slope near zero leads anywhere
    last = math.floor(max(high, begin - 2.0) - 0.5 + SLACK)
    return max(begin, np.int64(first)), min(end, np.int64(last))


@njit(parallel=True, **FAST)
def _draw(planes, boxes, lists, starts, near, size, found):
    """Draw triangles into bands. lists: triangles that touch each band of rows, in their order, from starts[band] on"""
    width, height = size
    farthest = 1 / near
    for band in prange(len(starts) - 1):
        top, bottom = band * BAND_ROWS, min((band + 1) * BAND_ROWS, height)
        buffer = np.zeros((BAND_ROWS, width), np.float64)
        found[top:bottom] = -1
        for p in range(starts[band], starts[band + 1]):
            f = lists[p]
            slope = planes[f, 0] + planes[f, 3] + planes[f, 6]
            for row in range(max(boxes[f, 2], top), min(boxes[f, 3], bottom - 1) + 1):
                y = row + 0.5
                begin, end = _span(planes, f, y, boxes[f, 0], boxes[f, 1])
                rest = (planes[f, 1] + planes[f, 4] + planes[f, 7]) * y + planes[f, 2] + planes[f, 5] + planes[f, 8]
                for column in range(begin, end + 1):
                    w = slope * (column + 0.5) + rest
                    if buffer[row - top, column] < w < farthest:
                        buffer[row - top, column] = w
                        found[row, column] = f


@njit(cache=True)
def _lists(boxes, bands):
    """Triangles of each band of rows."""
    starts = np.zeros(bands + 2, np.int64)
    for f in range(len(boxes)):
        for band in range(boxes[f, 2] // BAND_ROWS, boxes[f, 3] // BAND_ROWS + 1):
            starts[band + 2] += 1
    starts = np.cumsum(starts)
    lists = np.empty(starts[-1], np.int32)
    for f in range(len(boxes)):
        for band in range(boxes[f, 2] // BAND_ROWS, boxes[f, 3] // BAND_ROWS + 1):
            lists[starts[band + 1]] = f
            starts[band + 1] += 1
    return lists, starts[:-1]


@njit(**FAST)
def _barycentric(planes, f, x, y):
    """b_0, b_1, b_2 and z at a point of the picture."""
    u = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2]
    v = planes[f, 3] * x + planes[f, 4] * y + planes[f, 5]
    w = planes[f, 6] * x + planes[f, 7] * y + planes[f, 8]
    z = 1 / (u + v + w)
    return u * z, v * z, w * z, z


@njit(parallel=True, **FAST)
def _fill(planes, faces, attributes, found, values, depth):
    height, width = found.shape
    for row in prange(height):
        for column in range(width):
            f = found[row, column]
            values[row, column] = 0
            depth[row, column] = 0
            if f >= 0:
                p, q, r, z = _barycentric(planes, f, column + 0.5, row + 0.5)
                a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
                depth[row, column] = z
                for k in range(attributes.shape[1]):
                    values[row, column, k] = p * attributes[a, k] + q * attributes[b, k] + r * attributes[c, k]


@njit(**FAST)
def _sum_up(f, n, place, b, slope, to_values, to_depth, corners, attributes, faces, planes, own):
    """Add n pixels of a triangle to the gradients of its corners. place: of each pixel; b: barycentric coordinates"""
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    for m in range(n):
        far = np.float64(to_depth[place[m]])
        slope[0, m], slope[1, m], slope[2, m] = far * corners[i, 2], far * corners[j, 2], far * corners[k, 2]
        own[0, 2] += far * b[0, m]
        own[1, 2] += far * b[1, m]
        own[2, 2] += far * b[2, m]
    for channel in range(attributes.shape[1]):
        first, second, third = attributes[i, channel], attributes[j, channel], attributes[k, channel]
        p, q, r = 0.0, 0.0, 0.0
        for m in range(n):
            grad = np.float64(to_values[place[m], channel])
            slope[0, m] += grad * first
            slope[1, m] += grad * second
            slope[2, m] += grad * third
            p += grad * b[0, m]
            q += grad * b[1, m]
            r += grad * b[2, m]
        own[0, 3 + channel] += p
        own[1, 3 + channel] += q
        own[2, 3 + channel] += r
    for m in range(n):
        p, q, r = b[0, m], b[1, m], b[2, m]
        mean = slope[0, m] * p + slope[1, m] * q + slope[2, m] * r
        for axis in range(3):
            pull = planes[f, axis] * (slope[0, m] - mean) + planes[f, 3 + axis] * (slope[1, m] - mean)
            pull += planes[f, 6 + axis] * (slope[2, m] - mean)
            own[0, axis] -= p * pull
            own[1, axis] -= q * pull
            own[2, axis] -= r * pull


@njit(parallel=True, **FAST)
def _backward(to_values, to_depth, corners, attributes, faces, planes, boxes, found, parts, sums):
    """Gradients of each triangle's three corners: h, then attributes. With g_i = dL / db_i and M u = p,
    dL / du = z (g - sum_k g_k b_k) and dL / dh_i = -u_i M^-T dL / du, to which depth adds its b_i."""
    width = found.shape[1]
    for part in prange(parts):
        place, b, slope = np.empty(PIXELS, np.int64), np.empty((3, PIXELS)), np.empty((3, PIXELS))
        for f in range(len(faces) * part // parts, len(faces) * (part + 1) // parts):
            own, n = sums[f], 0
            own[:] = 0
            for row in range(boxes[f, 2], boxes[f, 3] + 1):
                begin, end = _span(planes, f, row + 0.5, boxes[f, 0], boxes[f, 1])
                for column in range(begin, end + 1):
                    if found[row, column] == f:
                        place[n] = row * width + column
                        b[0, n], b[1, n], b[2, n], _ = _barycentric(planes, f, column + 0.5, row + 0.5)
                        n += 1
                    if n == PIXELS:
                        _sum_up(f, n, place, b, slope, to_values, to_depth, corners, attributes, faces, planes, own)
                        n = 0
            _sum_up(f, n, place, b, slope, to_values, to_depth, corners, attributes, faces, planes, own)


@njit(parallel=True, **FAST)
def _gather(sums, faces, parts, to_corners, to_attributes):
    """Each thread adds up its own vertices, in the order of triangles."""
    vertices, channels = to_attributes.shape
    for part in prange(parts):
        begin, end = vertices * part // parts, vertices * (part + 1) // parts
        to_corners[begin:end] = 0
        to_attributes[begin:end] = 0
        for f in range(len(faces)):
            for i in range(3):
                vertex = faces[f, i]
                if begin <= vertex < end:
                    for axis in range(3):
                        to_corners[vertex, axis] += sums[f, i, axis]
                    for k in range(channels):
                        to_attributes[vertex, k] += sums[f, i, 3 + k]


def forward(ctx, corners, attributes, faces, size, near):
    width, height = size
    given = corners.detach().numpy(), faces.numpy()
    planes, boxes = np.zeros((len(faces), 9)), np.empty((len(faces), 4), np.int32)
    _measure(*given, near, size, planes, boxes)
    values, depth = empty(height, width, attributes.shape[1]), empty(height, width)
    found = empty(height, width, dtype=torch.int32)
    _draw(planes, boxes, *_lists(boxes, -(-height // BAND_ROWS)), near, size, found.numpy())
    pictures = (x.numpy() for x in (found, values, depth))
    _fill(planes, given[1], attributes.detach().numpy(), *pictures)
    ctx.save_for_backward(corners, attributes, faces, found)
    ctx.kept = planes, boxes
    ctx.mark_non_differentiable(found)
    return values, depth, found


def backward(ctx, to_values, to_depth, _):
    corners, attributes, faces, found = (x.detach().numpy() for x in ctx.saved_tensors)
    sums = np.empty((len(faces), 3, 3 + attributes.shape[1]))
    grads = to_values.flatten(0, 1).numpy(), to_depth.flatten().numpy()
    _backward(*grads, corners, attributes, faces, *ctx.kept, found, PARTS, sums)
    results = empty(*corners.shape), empty(*attributes.shape)
    _gather(sums, faces, get_num_threads(), *(x.numpy() for x in results))
    return *results, None, None, None


run = differentiable(forward, backward)
