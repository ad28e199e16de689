"""The loops over points and the depth that a camera sees in their direction (Numba)."""

from __future__ import annotations

import math

from numba import njit, prange


@njit(inline="always")
def depth_at(depth, x, y, jump):
    """Depth between pixels' centres, bilinear; at an edge, where they differ by `jump`, the nearest of the four."""
    height, width = depth.shape
    u, v = min(max(x - 0.5, 0.0), width - 1.0), min(max(y - 0.5, 0.0), height - 1.0)
    left, top = int(u), int(v)
    right, below = min(left + 1, width - 1), min(top + 1, height - 1)
    a, b, c, d = depth[top, left], depth[top, right], depth[below, left], depth[below, right]
    nearest = min(a, b, c, d)
    if max(a, b, c, d) - nearest >= jump:
        return nearest, False
    u, v = u - left, v - top
    return (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d), True


@njit(parallel=True, cache=True, error_model="numpy")
def against(pixels, valid, away, depth, jump, ahead, smooth):
    """sightings.compare: how far the surface lies behind each point, NaN outside the picture."""
    height, width = depth.shape
    for i in prange(len(away)):
        x, y = pixels[i, 0], pixels[i, 1]
        ahead[i], smooth[i] = math.nan, False
        if valid[i] and 0 <= x < width and 0 <= y < height:
            surface, smooth[i] = depth_at(depth, x, y, jump)
            ahead[i] = surface - away[i]


@njit(nogil=True, cache=True, error_model="numpy")
def fuse(pixels, valid, away, depth, facing, least, truncation, total, weight, pictured):
    """fusion.Fusion: one camera's word on each point, added to those of the others."""
    height, width = depth.shape
    for i in range(len(away)):
        x, y = pixels[i, 0], pixels[i, 1]
        if valid[i] and 0 <= x < width and 0 <= y < height:
            pictured[i] = True
            surface, smooth = depth_at(depth, x, y, truncation)
            ahead = surface - away[i]
            # At an edge only what lies in front of both sides is known.
            if ahead > (-truncation if smooth else truncation):
                share = max(facing[int(y), int(x)], least) / (away[i] * away[i])
                total[i] += share * min(ahead / truncation, 1.0)
                weight[i] += share
