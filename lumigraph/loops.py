"""The loops that every batch goes through before any field is asked: finding pixels, undoing lenses, samples (Numba).

Lenses are defined in lens.py on whole tensors; here the same equations go one ray at a time, without a tensor's traffic
for each term and without gradients.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange


@njit(parallel=True, cache=True, error_model="numpy")
def look_up(
    piece, chance, images, first, count, stride, width, start, before, ahead, first_run, pixels, image, xy, rgba, where
):
    """Where each random number lands, `piece` neighbours in the store at a time, and the bytes there.

    One number chooses both: the leading part of its 53 bits the image, the rest the pixel.
    where: filled with positions in the store, unless it is empty
    """
    for p in prange(len(chance)):
        share = chance[p] * len(images)
        choice = min(int(share), len(images) - 1)
        k = images[choice]
        begin = int((share - choice) * count[k])
        for i in range(p * piece, min((p + 1) * piece, len(image))):
            position = begin + i - p * piece
            pixel = position
            if piece > 1:  # shuffled
                position %= count[k]
                pixel = position * stride[k] % count[k]
            if len(start):
                rank = pixel + ahead[k]
                low, high = first_run[k], first_run[k + 1]
                while high - low > 1:
                    middle = (low + high) // 2
                    if before[middle] <= rank:
                        low = middle
                    else:
                        high = middle
                pixel = start[low] + rank - before[low]
                if piece == 1:
                    position = pixel
            y = int((pixel + 0.5) / width[k])  # quicker than dividing whole numbers
            image[i] = k
            xy[i, 0] = pixel - y * width[k] + 0.5
            xy[i, 1] = y + 0.5
            rgba[i] = pixels[first[k] + position]
            if len(where):
                where[i] = first[k] + position


@njit(parallel=True, cache=True, error_model="numpy")
def along(origins, directions, t_start, t_end, ray_starts, positions, seen_along):
    """Fill in where the middle of each sample is, and the direction it is seen along, as `Samples.along` says."""
    half = origins.dtype.type(0.5)
    for ray in prange(len(origins)):
        for i in range(ray_starts[ray], ray_starts[ray + 1]):
            t = half * (t_start[i] + t_end[i])
            for axis in range(3):
                positions[i, axis] = origins[ray, axis] + t * directions[ray, axis]
                seen_along[i, axis] = directions[ray, axis]


@njit(parallel=True, cache=True, error_model="numpy")
def contract(points, coordinates, stretch):
    """Contraction.warp and Contraction.stretch."""
    one, half = points.dtype.type(1), points.dtype.type(0.5)
    for i in prange(len(points)):
        x, y, z = points[i]
        inverse = one / max(math.sqrt(x * x + y * y + z * z), one)
        across = half * (one + one - inverse) * inverse
        coordinates[i, 0], coordinates[i, 1], coordinates[i, 2] = across * x, across * y, across * z
        if len(stretch):
            stretch[i] = np.cbrt(half * inverse * inverse * across * across)


@njit(inline="always")
def bend(x, y, d):
    """OpenCV's distortion and its Jacobian, as in lens.py. d: k1 k2 p1 p2 k3 k4 k5 k6."""
    s = x * x + y * y
    below = 1 / (1 + s * (d[5] + s * (d[6] + s * d[7])))
    q = (1 + s * (d[0] + s * (d[1] + s * d[4]))) * below
    slope = 2 * (d[0] + s * (2 * d[1] + s * 3 * d[4]) - q * (d[5] + s * (2 * d[6] + s * 3 * d[7]))) * below
    across, down = d[2] * y + d[3] * x, d[2] * x + d[3] * y
    bent_x, bent_y = x * (q + 2 * across) + d[3] * s, y * (q + 2 * across) + d[2] * s
    xx = q + x * x * slope + 2 * across + 4 * d[3] * x
    yy = q + y * y * slope + 2 * across + 4 * d[2] * y
    return bent_x, bent_y, xx, x * y * slope + 2 * down, yy


@njit(inline="always")
def within(x, y, limit):
    """A point of the plane, drawn back onto the disc of a radius."""
    s = x * x + y * y
    if s <= limit * limit:
        return x, y
    shrink = limit / math.sqrt(s)
    return x * shrink, y * shrink


@njit(parallel=True, cache=True, error_model="numpy")
def unbend(pixels, index, focal, centre, distortion, fold, steps, enough, directions):
    """OpenCV.unproject. index: the camera of each pixel, or empty for camera 0."""
    for i in prange(len(pixels)):
        c = index[i] if len(index) else 0
        limit = fold[c, 0]
        target_x = (pixels[i, 0] - centre[c, 0]) / focal[c, 0]
        target_y = (pixels[i, 1] - centre[c, 1]) / focal[c, 1]
        x, y = within(target_x, target_y, limit)
        for _ in range(steps):
            bent_x, bent_y, xx, xy, yy = bend(x, y, distortion[c])
            off_x, off_y = bent_x - target_x, bent_y - target_y
            share = 1 / max(xx * yy - xy * xy, 1e-3)
            step_x, step_y = share * (yy * off_x - xy * off_y), share * (xx * off_y - xy * off_x)
            x, y = within(x - step_x, y - step_y, limit)
            if abs(step_x) < enough and abs(step_y) < enough:
                break
        z = 1 / math.sqrt(1 + x * x + y * y)
        directions[i, 0] = x * z
        directions[i, 1] = y * z
        directions[i, 2] = z


@njit(parallel=True, cache=True, error_model="numpy")
def bent_solid_angle(directions, index, focal, distortion, angle):
    """OpenCV.solid_angle."""
    for i in prange(len(directions)):
        c = index[i] if len(index) else 0
        z = directions[i, 2]
        _, _, xx, xy, yy = bend(directions[i, 0] / z, directions[i, 1] / z, distortion[c])
        angle[i] = z * z * z / (max(xx * yy - xy * xy, 1e-3) * focal[c, 0] * focal[c, 1])
