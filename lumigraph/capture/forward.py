"""Captures that look one way: the mean camera, and a plane before everything that they see."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..datasets.scene import Forward
from .capture import Capture, Shot
from .normalise import reliable_points

MIN_AXIS_COSINE = math.cos(math.radians(30))  # of the angle between a camera's axis and the mean camera's
MAX_TANGENT = math.tan(math.radians(70))  # of the angle between a viewing ray and the mean camera's axis
MAX_MAGNIFICATION = 2.0  # relative to infinity: a plane just before the cameras must not squeeze the background
BORDER_POINTS = tuple((x, y) for x in (0.0, 0.5, 1.0) for y in (0.0, 0.5, 1.0))  # of a picture, and its centre
NEAR_PLANE_SCALE = 0.75  # times the distance from the mean camera to the nearest point, as in LLFF
OUTLIER_SHARE = 0.005  # of the sparse points may lie nearer


def find_forward(
    capture: Capture, shots: list[Shot], cameras: Camera, scene_from_source: Float[np.ndarray, "4 4"], near: float
) -> Forward | None:
    """Forward-facing frame of an unbounded capture; None if its cameras do not all look one way.

    shots, cameras: those to learn from; cameras in the scene's frame
    near:           distance from every camera within which nothing is, in scene units
    They do where each looks within 30 degrees of the mean camera, and a plane across its axis stands beyond all of them
    and before all that they see.
    """
    pose = mean_pose(cameras)
    if float((cameras.forward.double() @ pose[:, 2]).min()) < MIN_AXIS_COSINE:
        return None
    standing = (cameras.position.double() - pose[:, 3]) @ pose[:, 2]
    unit = float(np.cbrt(np.linalg.det(scene_from_source[:3, :3])))
    stated = [shot.depths[0] * unit for shot in shots if shot.depths is not None]
    cloud = reliable_points(capture, np.eye(4))
    if len(stated) == len(shots):
        nearest = float((standing + torch.tensor(stated)).min())
    elif cloud is not None:
        points = torch.from_numpy(cloud.points @ scene_from_source[:3, :3].T + scene_from_source[:3, 3])
        nearest = float(((points - pose[:, 3]) @ pose[:, 2]).quantile(OUTLIER_SHARE))
    else:
        nearest = float(standing.min()) + near
    foremost = float(standing.max())
    if nearest <= foremost:
        return None
    plane = max(NEAR_PLANE_SCALE * nearest, foremost)
    scale = fitting_scale(cameras, pose, plane)
    rows = tuple((a, b, c, d) for a, b, c, d in pose.tolist())
    return None if scale is None else Forward(rows, scale, plane)


def mean_pose(cameras: Camera) -> Float[Tensor, "3 4"]:
    """The mean position, and the rotation nearest to all (the chordal mean)."""
    mean = cameras.pose.double().mean(0)
    u, _, vt = torch.linalg.svd(mean[:, :3])
    proper = torch.tensor([1, 1, torch.linalg.det(u @ vt)], dtype=torch.float64)
    return torch.cat([u * proper @ vt, mean[:, 3:]], 1)


def fitting_scale(cameras: Camera, pose: Float[Tensor, "3 4"], plane: float) -> tuple[float, float] | None:
    """Factors on x / z and y / z in the mean camera that bring everything visible beyond the plane into [-1, 1]; None
    for lenses of too wide an angle.

    Mildenhall 2020 takes the focal lengths over half the picture. Cameras beside the mean one then see places beyond 1,
    which a positional encoding cannot tell from others.
    """
    count = len(BORDER_POINTS) * len(cameras)
    pixels = (torch.tensor(BORDER_POINTS) * cameras.size[:, None]).reshape(count, 2)
    rays = cameras.rays(pixels, torch.arange(len(cameras)).repeat_interleave(len(BORDER_POINTS)))
    origins, directions = (rays.origins - pose[:, 3]) @ pose[:, :3], rays.directions.double() @ pose[:, :3]
    if float(directions[:, 2].min()) <= 0:
        return None
    at_infinity = directions[:, :2] / directions[:, 2:]
    at_plane = (origins[:, :2] + at_infinity * (plane - origins[:, 2:])) / plane
    far, near = (x.abs().amax(0) for x in (at_infinity, at_plane))
    width, height = near.clamp(far, MAX_MAGNIFICATION * far).tolist()
    return None if float(far.max()) > MAX_TANGENT else (1 / width, 1 / height)
