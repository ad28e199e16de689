"""Reprojection: a small picture of a moving camera, with the detail of the last sharp one on common visible surfaces
(the reverse reprojection cache of Nehab 2007, with a small picture in place of the shader)."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numba import njit, prange
from torch import Tensor

from ..camera import Camera
from ..camera.lens import Pinhole

DEPTH_TOLERANCE = np.float32(0.02)  # relative difference of distances up to which two surfaces count as one
FAR = np.float32(1e6)  # scene units; where nothing is
STEPS = 2  # of the fixed-point iteration for the place in the sharp picture
FAST = {"cache": True, "fastmath": {"contract", "nsz"}, "error_model": "numpy"}


@dataclass(frozen=True)
class SharpPicture:
    """A picture rendered at rest, its depth along rays, its camera, and its settings."""

    picture: Float[Tensor, "height width 3"]
    depth: Float[Tensor, "height width"]
    camera: Camera
    settings: Any


def sharpened(
    small: Float[Tensor, "rows columns 3"], depth: Float[Tensor, "rows columns"], camera: Camera, sharp: SharpPicture
) -> Float[Tensor, "height width 3"]:
    """Picture at the camera's full size from a smaller one of the same view and the sharp picture of another.

    A pixel has the colour of the sharp picture if one of the four small pixels around it shows the same surface, else
    the small picture's, interpolated.
    """
    width, height = camera.size[0].tolist()
    found = torch.empty(height, width, 3)
    views = *numbers(sharp.camera), *numbers(camera)
    given = (x.contiguous().numpy() for x in (sharp.picture, sharp.depth, small, depth, *views, found))
    _reproject(*given)
    return found


def numbers(camera: Camera) -> tuple[Float[Tensor, "3 4"], Float[Tensor, " 4"]]:
    """Pose, focal lengths and centre of one pinhole camera."""
    lens = camera.lens
    assert isinstance(lens, Pinhole)
    return camera.pose[0].float(), torch.cat([lens.focal[0], lens.centre[0]]).float()


@njit(inline="always")
def _seen_at(point, pose, lens):
    """Pixel coordinates of a point of the world, its depth along the axis, its distance."""
    a, b, c = point[0] - pose[0, 3], point[1] - pose[1, 3], point[2] - pose[2, 3]
    x = pose[0, 0] * a + pose[1, 0] * b + pose[2, 0] * c
    y = pose[0, 1] * a + pose[1, 1] * b + pose[2, 1] * c
    z = pose[0, 2] * a + pose[1, 2] * b + pose[2, 2] * c
    return lens[0] * x / z + lens[2], lens[1] * y / z + lens[3], z, math.sqrt(a * a + b * b + c * c)


@njit(inline="always")
def _point(x, y, distance, pose, lens):
    """Point of the world at a distance along the ray of pixel coordinates (x, y)."""
    a, b = (x - lens[2]) / lens[0], (y - lens[3]) / lens[1]
    s = distance / math.sqrt(a * a + b * b + np.float32(1))
    return (
        pose[0, 3] + s * (pose[0, 0] * a + pose[0, 1] * b + pose[0, 2]),
        pose[1, 3] + s * (pose[1, 0] * a + pose[1, 1] * b + pose[1, 2]),
        pose[2, 3] + s * (pose[2, 0] * a + pose[2, 1] * b + pose[2, 2]),
    )


@njit(inline="always")
def _blend(picture, x, y, out):
    """Bilinear interpolation at pixel coordinates (x, y), clamped at the border."""
    height, width = picture.shape[:2]
    x, y = x - np.float32(0.5), y - np.float32(0.5)
    j, i = int(math.floor(x)), int(math.floor(y))
    b, a = x - np.float32(j), y - np.float32(i)
    i0, i1 = min(max(i, 0), height - 1), min(max(i + 1, 0), height - 1)
    j0, j1 = min(max(j, 0), width - 1), min(max(j + 1, 0), width - 1)
    for c in range(3):
        upper = picture[i0, j0, c] + b * (picture[i0, j1, c] - picture[i0, j0, c])
        lower = picture[i1, j0, c] + b * (picture[i1, j1, c] - picture[i1, j0, c])
        out[c] = upper + a * (lower - upper)


@njit(inline="always")
def _found(x, y, distance, depth, sharp_pose, sharp_lens, pose, lens):
    """Pixel in the sharp picture of the surface at a distance along the ray of (x, y), and True if visible there."""
    far = not distance < FAR
    point = _point(x, y, min(distance, FAR), pose, lens)
    u, v, z, expected = _seen_at(point, sharp_pose, sharp_lens)
    if not z > 0:
        return u, v, False
    for _ in range(STEPS):
        if not (0 <= u < depth.shape[1] and 0 <= v < depth.shape[0]):
            return u, v, False
        j, i = int(u), int(v)
        there = depth[i, j]
        if far:
            return u, v, not there < FAR
        if not abs(there - expected) < DEPTH_TOLERANCE * expected:
            return u, v, False
        # The surface of that pixel is seen at (s, t) now: the place is as far from the pixel as (x, y) from (s, t).
        middle, across = np.float32(j) + np.float32(0.5), np.float32(i) + np.float32(0.5)
        s, t, _, _ = _seen_at(_point(middle, across, there, sharp_pose, sharp_lens), pose, lens)
        u, v, expected = middle + (x - s), across + (y - t), there
    return u, v, True


@njit(parallel=True, **FAST)
def _reproject(sharp, sharp_depth, small, small_depth, sharp_pose, sharp_lens, pose, lens, out):
    """Fill in `sharpened`."""
    height, width = out.shape[:2]
    rows, columns = small_depth.shape
    for i in prange(height):
        for j in range(width):
            x, y = np.float32(j) + np.float32(0.5), np.float32(i) + np.float32(0.5)
            u, v = x * np.float32(columns) / np.float32(width), y * np.float32(rows) / np.float32(height)
            near_j, near_i = int(u), int(v)
            other_j = near_j + (1 if u - near_j > 0.5 else -1)
            other_i = near_i + (1 if v - near_i > 0.5 else -1)
            shown = False
            for k in range(4):
                row = min(max(other_i if k & 2 else near_i, 0), rows - 1)
                column = min(max(other_j if k & 1 else near_j, 0), columns - 1)
                distance = small_depth[row, column]
                a, b, shown = _found(x, y, distance, sharp_depth, sharp_pose, sharp_lens, pose, lens)
                if shown:
                    _blend(sharp, a, b, out[i, j])
                    break
            if not shown:
                _blend(small, u, v, out[i, j])
