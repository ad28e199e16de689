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
    for i in prange(len(points)):
        inverse, across = shrunk(points[i, 0], points[i, 1], points[i, 2])
        for axis in range(3):
            coordinates[i, axis] = across * points[i, axis]
        if len(stretch):
            stretch[i] = stretched(inverse, across)


@njit(inline="always")
def shrunk(x, y, z):
    """1 / |x|, at most 1, and what a point is multiplied with to be in the contraction's ball."""
    one, radius = np.float32(1), np.float32(math.sqrt(x * x + y * y + z * z))
    inverse = one / radius if radius > one else one
    return inverse, np.float32(0.5) * (one + one - inverse) * inverse


@njit(inline="always")
def stretched(inverse, across):
    """How much longer coordinates are than the scene, the mean of three directions; a half within the unit ball."""
    if inverse == 1:
        return across
    return (np.float32(0.5) * inverse * inverse * across * across) ** np.float32(1 / 3)


@njit(inline="always")
def cell(x, size):
    """Along one axis of corners that span [-1, 1]: the corner below a coordinate, and how far it is to the next."""
    s = min(max((x + np.float32(1)) * (np.float32(0.5) * np.float32(size - 1)), np.float32(0)), np.float32(size - 1))
    corner = max(min(np.int32(s), np.int32(size - 2)), np.int32(0))  # the last also where x is no number
    return corner, s - np.float32(corner)


@njit(inline="always")
def blended(values, size, x, y, z):
    """A grid's value at coordinates, between eight corners. values: flat, the last axis fastest"""
    (i, a), (j, b), (k, c) = cell(x, size[0]), cell(y, size[1]), cell(z, size[2])
    one, on = np.float32(1), size[2]
    at = (i * size[1] + j) * on + k
    plane = at + size[1] * on
    low = (values[at] * (one - c) + values[at + 1] * c) * (one - b)
    low += (values[at + on] * (one - c) + values[at + on + 1] * c) * b
    high = (values[plane] * (one - c) + values[plane + 1] * c) * (one - b)
    high += (values[plane + on] * (one - c) + values[plane + on + 1] * c) * b
    return low * (one - a) + high * a


@njit(inline="always")
def distance(share, near, far, first, last, forward):
    """Distance at a share of the way from near to far, as `Proposal` divides it.

    first, last: depths of the way's ends in normalised device coordinates; else its ends in what is even up to one unit
                 and in disparity beyond
    """
    one = np.float32(1)
    if forward:
        return near + (far - near) * (share * first / (share * first + (one - share) * last))
    s = first + share * (last - first)
    return s if s < one else one / max(one + one - s, np.float32(1e-6))


@njit(inline="always")
def exponential(x):
    """e^x to seven digits, in operations that the compiler does sixteen at a time; at least 2^-126."""
    doublings = max(x * np.float32(1.4426950409), np.float32(-126))
    whole = np.int32(doublings + np.float32(0.5)) if doublings > 0 else np.int32(doublings - np.float32(0.5))
    f = doublings - np.float32(whole)
    power = np.float32(0.0096181291) + f * (np.float32(0.0013333558) + f * np.float32(0.000154035))
    power = np.float32(0.2402265069) + f * (np.float32(0.0555041087) + f * power)
    power = np.float32(1) + f * (np.float32(0.6931471806) + f * power)
    return power * np.int32((whole + np.int32(127)) << np.int32(23)).view(np.float32)


@njit(inline="always")
def cube_root(x):
    """x^(1/3) of numbers above 0, likewise: a third of the exponent, then Newton's method."""
    third = np.int32(np.float32(np.float32(x).view(np.int32)) * np.float32(1 / 3))
    y = np.int32(third + np.int32(709921077)).view(np.float32)
    for _ in range(3):
        y = np.float32(2 / 3) * y + x / (np.float32(3) * y * y)
    return y


@njit(inline="always")
def look_through(edges, origin, direction, values, size, device, found, length):
    """Along one ray, the grid's value in the middle of each interval, and how long that is in coordinates."""
    one, forward = np.float32(1), len(device) > 0
    ox, oy, oz = origin
    dx, dy, dz = direction
    for i in range(len(found)):
        t = np.float32(0.5) * (edges[i] + edges[i + 1])
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        if forward:
            inverse = one / max(z, device[2])
            stretch = device[3] * inverse * cube_root(inverse)
            x, y, z = device[0] * x * inverse, device[1] * y * inverse, one - (one + one) * device[2] * inverse
        else:
            inverse, across = shrunk(x, y, z)
            stretch = cube_root(np.float32(0.5) * inverse * inverse * across * across) if inverse < one else across
            x, y, z = across * x, across * y, across * z
        length[i] = stretch * (edges[i + 1] - edges[i])
        found[i] = blended(values, size, x, y, z)


@njit(parallel=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def propose(block, bins, origins, directions, near, far, values, size, device, limits, edges):
    """Fill in the distances at which a field is asked, as `Proposal.sample` has them without jitter.

    block:  rays that share their memory
    device: of `NDC`, what turns its camera's x, y, z into coordinates, the near plane, and what `stretch` begins with;
            rays are then in that camera's frame. Empty in a contraction
    limits: what a log density counts for at most; the exponent of weights; the share of all weight that every bin has,
            and the weight that it has besides
    All bins of a ray go through each stage together, so that the compiler takes sixteen of them at a time.
    """
    one, forward, count = np.float32(1), len(device) > 0, edges.shape[1] - 1
    most, sharpness, spare, faint = limits[0], limits[1], limits[2], limits[3]
    for part in prange(-(-len(origins) // block)):
        ends, found, length = np.empty(bins + 1, np.float32), np.empty(bins, np.float32), np.empty(bins, np.float32)
        for ray in range(part * block, min((part + 1) * block, len(origins))):
            a, b = near[ray], far[ray]
            if forward:
                first = max(origins[ray, 2] + a * directions[ray, 2], device[2])
                last = max(origins[ray, 2] + b * directions[ray, 2], device[2])
            else:
                first = a if a < one else one + one - one / a
                last = b if b < one else one + one - one / b
            for i in range(bins + 1):
                ends[i] = distance(np.float32(np.int32(i)) / np.float32(bins), a, b, first, last, forward)
            origin = origins[ray, 0], origins[ray, 1], origins[ray, 2]
            direction = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            look_through(ends, origin, direction, values, size, device, found, length)
            for i in range(bins):
                found[i] = exponential(-exponential(min(found[i], most)) * length[i])
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
            least = spare / np.float32(bins) * total + faint
            whole = total + np.float32(bins) * least
            below, i = np.float32(0), 0
            for j in range(count + 1):
                share = whole * np.float32(j / count)
                while i < bins - 1 and below + found[i] + least <= share:
                    below += found[i] + least
                    i += 1
                inside = min(max((share - below) / (found[i] + least), np.float32(0)), one)
                edges[ray, j] = distance((np.float32(i) + inside) / np.float32(bins), a, b, first, last, forward)


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
