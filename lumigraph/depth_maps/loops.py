"""Loops over points and depth maps (Numba).

pixels, valid: (x, y) of points, and a mask of valid projections
away:          distances of the points from the camera
depth:         distances of the surface along the pixels' rays; infinity for empty space, NaN for unmeasured
"""

import math

import numpy as np
from numba import njit, prange


@njit(inline="always")
def depth_at(depth, x, y, edge):
    """Bilinear depth between pixel centres, and True; where one of the four is NaN, that of the pixel at (x, y), which
    may be NaN. At a depth edge, where the known ones differ by `edge`, the least and False."""
    height, width = depth.shape
    u, v = min(max(x - 0.5, 0.0), width - 1.0), min(max(y - 0.5, 0.0), height - 1.0)
    left, top = int(u), int(v)
    right, below = min(left + 1, width - 1), min(top + 1, height - 1)
    a, b, c, d = depth[top, left], depth[top, right], depth[below, left], depth[below, right]
    own, whole = depth[int(y), int(x)], not math.isnan(a + b + c + d)
    if math.isnan(own):
        return own, False
    nearest, farthest = own, own
    for value in (a, b, c, d):  # NaN is neither less nor more
        nearest, farthest = value if value < nearest else nearest, value if value > farthest else farthest
    if nearest == math.inf:
        return nearest, True
    if farthest - nearest >= edge:
        return nearest, False
    if not whole:
        return own, True
    u, v = u - left, v - top
    return (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d), True


@njit(parallel=True, cache=True, error_model="numpy")
def compare(pixels, valid, away, depth, edge, edge_per_distance, ahead, smooth):
    """Loop of DepthMap.compare: distance of the surface behind each point; NaN outside and for unmeasured."""
    height, width = depth.shape
    for i in prange(len(away)):
        x, y = pixels[i, 0], pixels[i, 1]
        ahead[i], smooth[i] = math.nan, False
        if valid[i] and 0 <= x < width and 0 <= y < height:
            surface, smooth[i] = depth_at(depth, x, y, edge + edge_per_distance * away[i])
            ahead[i] = surface - away[i]


@njit(nogil=True, cache=True, error_model="numpy")
def fuse(pixels, valid, away, depth, facing, least, edges, truncations, total, weight, truncated, pictured):
    """Loop of TSDF: add one camera's distances. edges and truncations are tolerances (constant, per distance)"""
    height, width = depth.shape
    for i in range(len(away)):
        x, y = pixels[i, 0], pixels[i, 1]
        if valid[i] and 0 <= x < width and 0 <= y < height:
            truncation = truncations[0] + truncations[1] * away[i]
            surface, smooth = depth_at(depth, x, y, edges[0] + edges[1] * away[i])
            ahead = surface - away[i]
            if not math.isnan(ahead):
                pictured[i] = True
            # At an edge only what lies in front of both sides is known; where the depth is NaN, nothing.
            if ahead > (-truncation if smooth else truncation):
                share = max(facing[int(y), int(x)], least) / (away[i] * away[i])
                total[i] += share * min(ahead / truncation, 1.0)
                weight[i] += share
                truncated[i] += share * truncation


@njit(inline="always")
def known_step(depth, y, x, dy, dx, reach):
    """Steps to the next known pixel along a direction, at most `reach`, and the difference of its depth; 0, infinity
    without one."""
    height, width = depth.shape
    for k in range(1, reach + 1):
        row, column = y + k * dy, x + k * dx
        if not (0 <= row < height and 0 <= column < width):
            break
        if depth[row, column] > 0 and depth[row, column] < math.inf:
            return k, abs(depth[row, column] - depth[y, x])
    return 0, math.inf


@njit(parallel=True, cache=True, error_model="numpy")
def incidence(depth, directions, reach, out):
    """Cosine between each pixel's ray and its surface normal, from differences to the nearer in depth of two known
    pixels along each axis; 0 for unknown depth of the pixel, or of all within `reach` of it along an axis.

    directions: (height, width, 3), unit length
    """
    height, width = depth.shape
    for y in prange(height):
        for x in range(width):
            here, out[y, x] = depth[y, x], 0.0
            if not (here > 0 and here < math.inf):
                continue
            left, from_left = known_step(depth, y, x, 0, -1, reach)
            right, from_right = known_step(depth, y, x, 0, 1, reach)
            above, from_above = known_step(depth, y, x, -1, 0, reach)
            under, from_under = known_step(depth, y, x, 1, 0, reach)
            along_x = -left if from_left <= from_right else right
            along_y = -above if from_above <= from_under else under
            if along_x == 0 or along_y == 0:
                continue
            beside, below = depth[y, x + along_x], depth[y + along_y, x]
            dx, dy, dz = directions[y, x, 0], directions[y, x, 1], directions[y, x, 2]
            ax = beside * directions[y, x + along_x, 0] - here * dx
            ay = beside * directions[y, x + along_x, 1] - here * dy
            az = beside * directions[y, x + along_x, 2] - here * dz
            bx = below * directions[y + along_y, x, 0] - here * dx
            by = below * directions[y + along_y, x, 1] - here * dy
            bz = below * directions[y + along_y, x, 2] - here * dz
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            if length > 0:
                out[y, x] = abs(nx * dx + ny * dy + nz * dz) / length


@njit(cache=True, error_model="numpy")
def fill_disparity(found, its, state, rgb, directions, per_direction, reach, colour, distance, out):
    """Loop of stereo.filled: disparities of occluded pixels from known pixels around them.

    found, its: disparity of this picture and of the other, whose pixel is at x - found; state: 0 for known, 1 for
    occluded, 2 for outside the other picture; rgb: bytes; out: initially `found`
    """
    height, width = found.shape
    values = np.empty(len(directions) * per_direction, np.float32)
    weights = np.empty_like(values)
    for y in range(height):
        for x in range(width):
            if state[y, x] == 0:
                continue
            count, whole = 0, np.float32(0)
            for k in range(len(directions) if state[y, x] == 1 else 0):
                dx, dy = directions[k, 0], directions[k, 1]
                i, j, got, step = x + dx, y + dy, 0, 1
                while 0 <= i < width and 0 <= j < height and step < reach and got < per_direction:
                    if state[j, i] == 0:
                        got += 1
                        u = x - int(round(found[j, i]))
                        # In front of what the other picture shows, this pixel would have been shown as well.
                        if u < 0 or u >= width or its[y, u] > found[j, i] - 1:
                            apart = abs(float(rgb[y, x, 0]) - rgb[j, i, 0]) + abs(float(rgb[y, x, 1]) - rgb[j, i, 1])
                            apart += abs(float(rgb[y, x, 2]) - rgb[j, i, 2])
                            weight = np.float32(math.exp(-apart / colour - step / distance) + 1e-6)
                            place = count
                            while place > 0 and values[place - 1] > found[j, i]:
                                values[place], weights[place] = values[place - 1], weights[place - 1]
                                place -= 1
                            values[place], weights[place] = found[j, i], weight
                            count, whole = count + 1, whole + weight
                    i, j, step = i + dx, j + dy, step + 1
            if count > 0:
                passed, k = weights[0], 0
                while passed < whole / 2 and k < count - 1:
                    k += 1
                    passed += weights[k]
                out[y, x] = values[k]
                continue
            nearest = math.inf  # the farther of the known pixels to the left and to the right
            for towards in (-1, 1):
                i = x + towards
                while 0 <= i < width and state[y, i] != 0:
                    i += towards
                if 0 <= i < width:
                    nearest = min(nearest, found[y, i])
            if nearest < math.inf:
                out[y, x] = nearest
