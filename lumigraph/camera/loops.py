"""Loops over rays and samples on the CPU, in single precision and without gradients (Numba).

Every batch of rays needs them. They follow the equations of `OpenCV` and `Samples.along`, without a tensor's memory
traffic for each term.
"""

import math

from numba import njit, prange


@njit(inline="always")
def distort(x, y, d):
    """OpenCV's distortion and its Jacobian, as `bend`. d: k1 k2 p1 p2 k3 k4 k5 k6"""
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
def clamp_radius(x, y, limit):
    """A point of the plane, clamped to a disc of a radius."""
    s = x * x + y * y
    if s <= limit * limit:
        return x, y
    shrink = limit / math.sqrt(s)
    return x * shrink, y * shrink


@njit(parallel=True, cache=True, error_model="numpy")
def undistort(pixels, index, focal, centre, distortion, fold, steps, tolerance, directions):
    """Fill in the directions of `OpenCV.unproject`. index: the camera of each pixel, or empty for camera 0."""
    for i in prange(len(pixels)):
        c = index[i] if len(index) else 0
        limit = fold[c, 0]
        target_x = (pixels[i, 0] - centre[c, 0]) / focal[c, 0]
        target_y = (pixels[i, 1] - centre[c, 1]) / focal[c, 1]
        x, y = clamp_radius(target_x, target_y, limit)
        for _ in range(steps):
            bent_x, bent_y, xx, xy, yy = distort(x, y, distortion[c])
            off_x, off_y = bent_x - target_x, bent_y - target_y
            share = 1 / max(xx * yy - xy * xy, 1e-3)
            step_x, step_y = share * (yy * off_x - xy * off_y), share * (xx * off_y - xy * off_x)
            x, y = clamp_radius(x - step_x, y - step_y, limit)
            if abs(step_x) < tolerance and abs(step_y) < tolerance:
                break
        z = 1 / math.sqrt(1 + x * x + y * y)
        directions[i, 0] = x * z
        directions[i, 1] = y * z
        directions[i, 2] = z


@njit(parallel=True, cache=True, error_model="numpy")
def solid_angle(directions, index, focal, distortion, angle):
    """Fill in the steradians of `OpenCV.solid_angle`."""
    for i in prange(len(directions)):
        c = index[i] if len(index) else 0
        z = directions[i, 2]
        _, _, xx, xy, yy = distort(directions[i, 0] / z, directions[i, 1] / z, distortion[c])
        angle[i] = z * z * z / (max(xx * yy - xy * xy, 1e-3) * focal[c, 0] * focal[c, 1])


@njit(parallel=True, cache=True, error_model="numpy")
def fill_midpoints(origins, directions, t_start, t_end, ray_starts, positions, sample_directions):
    """Fill in the position of each sample's middle and the direction of its ray, as `Samples.along` returns them."""
    half = origins.dtype.type(0.5)
    for ray in prange(len(origins)):
        for i in range(ray_starts[ray], ray_starts[ray + 1]):
            t = half * (t_start[i] + t_end[i])
            for axis in range(3):
                positions[i, axis] = origins[ray, axis] + t * directions[ray, axis]
                sample_directions[i, axis] = directions[ray, axis]
