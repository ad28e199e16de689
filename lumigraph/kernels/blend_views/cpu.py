"""Numba. A task takes a run of points and keeps each point's least penalties in order."""

import numpy as np
from numba import njit, prange

from .._operation import empty
from . import BEHIND_DEPTH, MIN_PENALTY, NOTHING, UNSEEN

CHUNK = 1024  # points of a task
MIN_DEPTH, TINY = np.float32(BEHIND_DEPTH), np.float32(MIN_PENALTY)
NEVER, NO_SURFACE = np.float32(UNSEEN), np.float32(NOTHING)
ZERO, HALF, ONE, TWO, BYTE = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2), np.float32(1 / 255)
FAST = {"fastmath": True, "error_model": "numpy"}


@njit(**FAST)
def _place(poses, lenses, n, px, py, pz):
    """Pixel of a point, and its distance; distance 0 if the point is outside the view."""
    x = poses[n, 0, 0] * px + poses[n, 0, 1] * py + poses[n, 0, 2] * pz + poses[n, 0, 3]
    y = poses[n, 1, 0] * px + poses[n, 1, 1] * py + poses[n, 1, 2] * pz + poses[n, 1, 3]
    z = poses[n, 2, 0] * px + poses[n, 2, 1] * py + poses[n, 2, 2] * pz + poses[n, 2, 3]
    if z <= MIN_DEPTH:
        return ZERO, ZERO, ZERO
    away = np.sqrt(x * x + y * y + z * z)
    x /= z
    y /= z
    s = x * x + y * y
    if s > lenses[n, 12] * lenses[n, 12]:
        return ZERO, ZERO, ZERO
    q = ONE + s * (lenses[n, 4] + s * (lenses[n, 5] + s * lenses[n, 8]))
    q /= ONE + s * (lenses[n, 9] + s * (lenses[n, 10] + s * lenses[n, 11]))
    p1, p2 = lenses[n, 6], lenses[n, 7]
    u = x * q + TWO * p1 * x * y + p2 * (s + TWO * x * x)
    v = y * q + p1 * (s + TWO * y * y) + TWO * p2 * x * y
    return u * lenses[n, 0] + lenses[n, 2], v * lenses[n, 1] + lenses[n, 3], away


@njit(**FAST)
def _gap(depths, n, u, v, width, height, away):
    """Least difference between a distance and the four depths around a pixel; UNSEEN if all are unknown."""
    x = min(max(u - HALF, ZERO), np.float32(width - 1))
    y = min(max(v - HALF, ZERO), np.float32(height - 1))
    left, top = int(x), int(y)
    best = NEVER
    for row in (top, min(top + 1, height - 1)):
        for column in (left, min(left + 1, width - 1)):
            t = depths[n, row, column]
            if t > ZERO:
                best = min(best, abs(away - t) if t < NO_SURFACE else ZERO)
    return best


@njit(**FAST)
def _add_colour(pictures, n, u, v, width, height, weight, out, i):
    """Add a photograph's interpolated colour, times a weight, to row i."""
    x = min(max(u - HALF, ZERO), np.float32(width - 1))
    y = min(max(v - HALF, ZERO), np.float32(height - 1))
    left, top = int(x), int(y)
    right, below = min(left + 1, width - 1), min(top + 1, height - 1)
    x -= np.float32(left)
    y -= np.float32(top)
    weight *= BYTE
    a, b, c, d = (ONE - y) * (ONE - x), (ONE - y) * x, y * (ONE - x), y * x
    for k in range(pictures.shape[3]):
        value = a * np.float32(pictures[n, top, left, k]) + b * np.float32(pictures[n, top, right, k])
        value += c * np.float32(pictures[n, below, left, k]) + d * np.float32(pictures[n, below, right, k])
        out[i, k] += weight * value


@njit(parallel=True, cache=True, **FAST)
def _blend(
    points, eyes, focal, pictures, depths, sizes, poses, lenses, centres, inverse_focal, count, resolution_weight,
    hidden_weight, tolerance, border, rgb, seen,
):  # fmt: skip
    views, last = len(pictures), min(count, len(pictures))
    for chunk in prange((len(points) + CHUNK - 1) // CHUNK):
        penalties, places, shares = (
            np.empty(last + 1, np.float32),
            np.empty((last + 1, 2), np.float32),
            np.empty(last + 1, np.float32),
        )
        chosen = np.empty(last + 1, np.int64)
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(points))):
            px, py, pz = points[i, 0], points[i, 1], points[i, 2]
            dx, dy, dz = px - eyes[i, 0], py - eyes[i, 1], pz - eyes[i, 2]
            own = np.sqrt(dx * dx + dy * dy + dz * dz)
            over = ONE / max(own, MIN_DEPTH)
            dx, dy, dz = dx * over, dy * over, dz * over
            penalties[:] = NEVER
            for n in range(views):
                u, v, away = _place(poses, lenses, n, px, py, pz)
                if away == ZERO:
                    continue
                width, height = np.float32(sizes[n, 0]), np.float32(sizes[n, 1])
                share = min(min(u, width - u) / width, min(v, height - v) / height) / border
                if share <= ZERO:
                    continue
                wide, high = sizes[n, 2], sizes[n, 3]
                at_u, at_v = u / width * np.float32(wide), v / height * np.float32(high)
                gap = _gap(depths, n, at_u, at_v, wide, high, away)
                if gap >= NEVER:
                    continue
                gap = min(max(gap / away - tolerance, ZERO), ONE)
                cx, cy, cz = px - centres[n, 0], py - centres[n, 1], pz - centres[n, 2]
                back = ONE / np.sqrt(cx * cx + cy * cy + cz * cz)
                cx, cy, cz = dx - cx * back, dy - cy * back, dz - cz * back
                chord = np.sqrt(cx * cx + cy * cy + cz * cz)
                coarse = max(away * focal * inverse_focal[n] * over - ONE, ZERO)
                penalty = chord * (ONE + hidden_weight * gap) + resolution_weight * coarse
                if penalty < penalties[last]:
                    k = last
                    while k > 0 and penalty < penalties[k - 1]:
                        penalties[k], shares[k], chosen[k] = penalties[k - 1], shares[k - 1], chosen[k - 1]
                        places[k, 0], places[k, 1] = places[k - 1, 0], places[k - 1, 1]
                        k -= 1
                    penalties[k], shares[k], chosen[k] = penalty, min(share, ONE), n
                    places[k, 0], places[k, 1] = u, v
            worst = max(penalties[last], TINY) if count < views else NEVER
            total, most = ZERO, ZERO
            rgb[i] = ZERO
            even = penalties[0] < NEVER and penalties[0] >= worst
            for k in range(last + (1 if even else 0)):
                if penalties[k] >= NEVER:
                    break
                w = shares[k] if even else shares[k] * (ONE - penalties[k] / worst) / (penalties[k] + TINY)
                if w > ZERO:
                    n = chosen[k]
                    _add_colour(pictures, n, places[k, 0], places[k, 1], sizes[n, 0], sizes[n, 1], w, rgb, i)
                    total += w
                    most = max(most, shares[k])
            if total > ZERO:
                for k in range(rgb.shape[1]):
                    rgb[i, k] /= total
            seen[i] = most


def run(
    points, eyes, focal, pictures, depths, sizes, poses, lenses, count, resolution_weight, hidden_weight, tolerance,
    border,
):  # fmt: skip
    rgb, seen = empty(len(points), pictures.shape[3]), empty(len(points))
    centres = -(poses[:, :, :3].mT @ poses[:, :, 3:])[..., 0]
    inverse_focal = 1 / (lenses[:, 0] * lenses[:, 1]).sqrt()
    first = (x.contiguous().numpy() for x in (points, eyes))
    views = (x.contiguous().numpy() for x in (pictures, depths, sizes.long(), poses, lenses, centres, inverse_focal))
    numbers = (np.float32(x) for x in (resolution_weight, hidden_weight, tolerance, border))
    _blend(*first, np.float32(focal), *views, count, *numbers, rgb.numpy(), seen.numpy())
    return rgb, seen
