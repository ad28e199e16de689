"""Loops over triangles and texels (Numba)."""

import math

from numba import njit, prange

EDGE_TRUST = 1e-3  # in pixels at an edge of the surface, the picture or its mask
INSIDE = -1e-9  # least barycentric coordinate of a point inside a triangle, for shared edges


@njit(inline="always")
def span(a, b, c, size):
    """First and last pixel whose centre lies between the least and the greatest of three coordinates."""
    low, high = min(a, b, c), max(a, b, c)
    return max(0, math.ceil(low - 0.5)), min(size - 1, math.floor(high - 0.5))


@njit(inline="always")
def placed(corners, f, height, width):
    """Coordinates and twice the signed area of triangle f, and the rows and columns of pixels that it may cover."""
    ax, ay, bx, by, cx, cy = corners[f].ravel()
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if not abs(area) > 0:
        return (ax, ay, bx, by, cx, cy, area), range(0), range(0)
    left, right = span(ax, bx, cx, width)
    top, bottom = span(ay, by, cy, height)
    return (ax, ay, bx, by, cx, cy, area), range(top, bottom + 1), range(left, right + 1)


@njit(inline="always")
def covers(triangle, row, column):
    """True if a triangle covers a pixel's centre."""
    ax, ay, bx, by, cx, cy, area = triangle
    x, y = column + 0.5, row + 0.5
    v = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
    w = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
    return v >= INSIDE and w >= INSIDE and v + w <= 1 - INSIDE


@njit(nogil=True, cache=True, error_model="numpy")
def rasterize(corners, face):
    """The first triangle over each pixel's centre. corners: (triangle, 3, 2) in pixels; face: (row, column), -1 at
    first"""
    height, width = face.shape
    for f in range(len(corners)):
        triangle, rows, columns = placed(corners, f, height, width)
        for row in rows:
            for column in columns:
                if face[row, column] < 0 and covers(triangle, row, column):
                    face[row, column] = f


@njit(nogil=True, cache=True, error_model="numpy")
def first_faces(corners, normals, offsets, directions, face, depth):
    """The nearest triangle in each pixel, and the distance t along the pixel's ray to its plane, t = n (a - o) / (n d).

    corners:    (triangle, 3, 2) in pixels, NaN for one that the lens does not see whole
    normals:    (triangle, 3) of planes, offsets: n (a - o) with a point a of each and the camera's position o
    directions: (row, column, 3) of rays
    face, depth: (row, column), -1 and infinity at first
    """
    height, width = face.shape
    for f in range(len(corners)):
        triangle, rows, columns = placed(corners, f, height, width)
        for row in rows:
            for column in columns:
                if covers(triangle, row, column):
                    d = directions[row, column]
                    t = offsets[f] / (normals[f, 0] * d[0] + normals[f, 1] * d[1] + normals[f, 2] * d[2])
                    if 0 < t < depth[row, column]:
                        face[row, column], depth[row, column] = f, t


@njit(inline="always")
def corners_of(x, y, height, width):
    """Rows, columns and weights of bilinear interpolation between pixels' centres."""
    u, v = min(max(x - 0.5, 0.0), width - 1.0), min(max(y - 0.5, 0.0), height - 1.0)
    left, top = int(u), int(v)
    return left, top, min(left + 1, width - 1), min(top + 1, height - 1), u - left, v - top


@njit(parallel=True, cache=True, error_model="numpy")
def collect(texels, pixels, away, quality, rgb, depth, trust, tolerance, view, colours, scores, views):
    """One picture's colours of texels, each kept if it is among the best of its texel.

    texels:    numbers of texels; of each its place `pixels` (x, y), distance `away` and `quality` in this picture
    rgb:       bytes (row, column, 3); depth of the surface, and trust, a factor of quality, of each pixel
    tolerance: between a texel's distance and the depth, beyond which something else is in front of it
    colours, scores, views: (texel, rank ...) of the best so far; a score of 0 is none
    """
    height, width = depth.shape
    for i in prange(len(texels)):
        x, y = pixels[i, 0], pixels[i, 1]
        if not (0 <= x < width and 0 <= y < height):
            continue
        sure = trust[int(y), int(x)]
        if not sure > 0 or not quality[i] > 0:
            continue
        left, top, right, below, u, v = corners_of(x, y, height, width)
        if sure < 2 * EDGE_TRUST:  # the pixels around show something else
            left = right = int(x)
            top = below = int(y)
        upper = (1 - u) * depth[top, left] + u * depth[top, right]
        lower = (1 - u) * depth[below, left] + u * depth[below, right]
        surface = (1 - v) * upper + v * lower
        if not abs(surface - away[i]) <= tolerance:
            continue
        n, score, worst = texels[i], sure * quality[i], 0
        for k in range(1, scores.shape[1]):
            if scores[n, k] < scores[n, worst]:
                worst = k
        if score > scores[n, worst]:
            scores[n, worst], views[n, worst] = score, view
            for k in range(3):
                a = (1 - u) * rgb[top, left, k] + u * rgb[top, right, k]
                b = (1 - u) * rgb[below, left, k] + u * rgb[below, right, k]
                colours[n, worst, k] = int((1 - v) * a + v * b + 0.5)
