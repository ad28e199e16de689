"""Numba: one thread takes a block of rays. All bins of a ray go through each stage together, vectorised."""

import numpy as np
from numba import njit, prange

from .._operation import empty
from ..contract.cpu import cube_root, scale_of

BLOCK = 64  # rays that share their memory


@njit(inline="always")
def _cell(x, size):
    """Along one axis of corners that span [-1, 1]: the corner below a coordinate, and the fraction towards the next."""
    s = min(max((x + np.float32(1)) * (np.float32(0.5) * np.float32(size - 1)), np.float32(0)), np.float32(size - 1))
    corner = max(min(np.int32(s), np.int32(size - 2)), np.int32(0))  # the last also where x is no number
    return corner, s - np.float32(corner)


@njit(inline="always")
def _interpolated(values, size, x, y, z):
    """Trilinear interpolation of a grid's eight corners. values: flat, the last axis fastest"""
    (i, a), (j, b), (k, c) = _cell(x, size[0]), _cell(y, size[1]), _cell(z, size[2])
    one, on = np.float32(1), size[2]
    at = (i * size[1] + j) * on + k
    plane = at + size[1] * on
    low = (values[at] * (one - c) + values[at + 1] * c) * (one - b)
    low += (values[at + on] * (one - c) + values[at + on + 1] * c) * b
    high = (values[plane] * (one - c) + values[plane + 1] * c) * (one - b)
    high += (values[plane + on] * (one - c) + values[plane + on + 1] * c) * b
    return low * (one - a) + high * a


@njit(inline="always")
def _distance(share, near, far, first, last, forward):
    """Distance at s between near (0) and far (1). first, last: depths of the ends in a frustum, else their s"""
    one = np.float32(1)
    if forward:
        return near + (far - near) * (share * first / (share * first + (one - share) * last))
    s = first + share * (last - first)
    return s if s < one else one / max(one + one - s, np.float32(1e-6))


@njit(inline="always")
def exponential(x):
    """e^x to seven digits, at least 2^-126, in operations that the compiler vectorises."""
    doublings = max(x * np.float32(1.4426950409), np.float32(-126))
    whole = np.int32(doublings + np.float32(0.5)) if doublings > 0 else np.int32(doublings - np.float32(0.5))
    f = doublings - np.float32(whole)
    power = np.float32(0.0096181291) + f * (np.float32(0.0013333558) + f * np.float32(0.000154035))
    power = np.float32(0.2402265069) + f * (np.float32(0.0555041087) + f * power)
    power = np.float32(1) + f * (np.float32(0.6931471806) + f * power)
    return power * np.int32((whole + np.int32(127)) << np.int32(23)).view(np.float32)


@njit(inline="always")
def _look_up(edges, origin, direction, values, size, frustum, found, length):
    """Grid value in the middle of each bin along one ray, and the bin's length in coordinates."""
    one, forward = np.float32(1), len(frustum) > 0
    ox, oy, oz = origin
    dx, dy, dz = direction
    for i in range(len(found)):
        t = np.float32(0.5) * (edges[i] + edges[i + 1])
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        if forward:
            inverse = one / max(z, frustum[2])
            stretch = frustum[3] * inverse * cube_root(inverse)
            x, y, z = frustum[0] * x * inverse, frustum[1] * y * inverse, one - (one + one) * frustum[2] * inverse
        else:
            inverse, across = scale_of(x, y, z)
            stretch = cube_root(np.float32(0.5) * inverse * inverse * across * across) if inverse < one else across
            x, y, z = across * x, across * y, across * z
        length[i] = stretch * (edges[i + 1] - edges[i])
        found[i] = _interpolated(values, size, x, y, z)


@njit(parallel=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _sample(bins, origins, directions, near, far, values, size, frustum, limits, edges):
    """Edges of rays. frustum: scale of x, of y, near plane, and the factor of |det J|^(1/3); empty for a contraction
    limits: numbers of the Resampling, from max_log_density on"""
    one, forward, count = np.float32(1), len(frustum) > 0, edges.shape[1] - 1
    max_log_density, sharpness, uniform_share, min_weight = limits[0], limits[1], limits[2], limits[3]
    for part in prange(-(-len(origins) // BLOCK)):
        ends, found, length = np.empty(bins + 1, np.float32), np.empty(bins, np.float32), np.empty(bins, np.float32)
        for ray in range(part * BLOCK, min((part + 1) * BLOCK, len(origins))):
            a, b = near[ray], far[ray]
            if forward:
                first = max(origins[ray, 2] + a * directions[ray, 2], frustum[2])
                last = max(origins[ray, 2] + b * directions[ray, 2], frustum[2])
            else:
                first = a if a < one else one + one - one / a
                last = b if b < one else one + one - one / b
            for i in range(bins + 1):
                ends[i] = _distance(np.float32(np.int32(i)) / np.float32(bins), a, b, first, last, forward)
            origin = origins[ray, 0], origins[ray, 1], origins[ray, 2]
            direction = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            _look_up(ends, origin, direction, values, size, frustum, found, length)
            for i in range(bins):
                found[i] = exponential(-exponential(min(found[i], max_log_density)) * length[i])
            passed, total = one, np.float32(0)
            for i in range(bins):
                left = found[i]
                found[i] = passed * (one - left)
                passed *= left
            if sharpness != one:
                for i in range(bins):
                    found[i] **= sharpness
            for i in range(bins):
                total += found[i]
            least = uniform_share / np.float32(bins) * total + min_weight
            whole = total + np.float32(bins) * least
            below, i = np.float32(0), 0
            for j in range(count + 1):
                share = whole * np.float32(j / count)
                while i < bins - 1 and below + found[i] + least <= share:
                    below += found[i] + least
                    i += 1
                inside = min(max((share - below) / (found[i] + least), np.float32(0)), one)
                edges[ray, j] = _distance((np.float32(i) + inside) / np.float32(bins), a, b, first, last, forward)


def run(origins, directions, near, far, log_density, resampling, frustum):
    numbers = list[float]()
    if frustum is not None:
        scale_x, scale_y, plane = frustum
        numbers = [scale_x, scale_y, plane, (2 * scale_x * scale_y * plane) ** (1 / 3)]
    r, edges = resampling, empty(len(origins), resampling.samples + 1)
    limits = np.array((r.max_log_density, r.sharpness, r.uniform_share, r.min_weight), np.float32)
    tensors = [x.detach().contiguous().numpy() for x in (origins, directions, near, far, log_density.flatten())]
    size = np.array(log_density.shape)
    _sample(r.bins, *tensors, size, np.array(numbers, np.float32), limits, edges.numpy())
    return edges
