"""Captures that look one way: the mean camera, and a plane before everything that they see."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..scene import Forward
from .capture import Capture, Shot
from .normalise import reliable_points

ONE_WAY = math.cos(math.radians(30))  # of the angle between a camera's axis and the mean camera's, at most
WIDEST = math.tan(math.radians(70))  # half a picture, seen from its camera
BEFORE_NEAREST = (
    0.75  # of the way from the mean camera to the nearest thing: where the plane stands (LLFF's own factor)
)
STRAY = 0.005  # share of sparse points that may lie nearer by mistake


def find_forward(
    capture: Capture, shots: list[Shot], cameras: Camera, scene_from_source: Float[np.ndarray, "4 4"], near: float
) -> Forward | None:
    """How the cameras of an unbounded capture look one way; None if they do not.

    shots, cameras: those to learn from; cameras in the scene's frame
    near:           distance from every camera within which nothing is, in scene units
    They do where each looks within 30 degrees of the mean camera, and a plane across its axis stands beyond all of them
    and before all that they see.
    """
    pose, scale = mean_pose(cameras), mean_scale(cameras)
    if scale is None or float((cameras.forward.double() @ pose[:, 2]).min()) < ONE_WAY:
        return None
    standing = (cameras.position.double() - pose[:, 3]) @ pose[:, 2]
    unit = float(np.cbrt(np.linalg.det(scene_from_source[:3, :3])))
    stated = [shot.depths[0] * unit for shot in shots if shot.depths is not None]
    cloud = reliable_points(capture, np.eye(4))
    if len(stated) == len(shots):
        nearest = float((standing + torch.tensor(stated)).min())
    elif cloud is not None:
        points = torch.from_numpy(cloud.points @ scene_from_source[:3, :3].T + scene_from_source[:3, 3])
        nearest = float(((points - pose[:, 3]) @ pose[:, 2]).quantile(STRAY))
    else:
        nearest = float(standing.min()) + near
    foremost = float(standing.max())
    if nearest <= foremost:
        return None
    rows = tuple((a, b, c, d) for a, b, c, d in pose.tolist())
    return Forward(rows, scale, max(BEFORE_NEAREST * nearest, foremost))


def mean_pose(cameras: Camera) -> Float[Tensor, "3 4"]:
    """The mean position, and the rotation nearest to all (the chordal mean)."""
    mean = cameras.pose.double().mean(0)
    u, _, vt = torch.linalg.svd(mean[:, :3])
    proper = torch.tensor([1, 1, torch.linalg.det(u @ vt)], dtype=torch.float64)
    return torch.cat([u * proper @ vt, mean[:, 3:]], 1)


def mean_scale(cameras: Camera) -> tuple[float, float] | None:
    """Focal lengths over half the picture, as the middles of its edges tell; None for lenses that see too widely."""
    width, height = cameras.size.float().T
    every = torch.arange(len(cameras))
    found = []
    for axis, far in enumerate((torch.stack([width, height / 2], -1), torch.stack([width / 2, height], -1))):
        near = far.clone()
        near[:, axis] = 0
        slopes = [edge[:, axis].abs() / edge[:, 2] for edge in (cameras.lens.unproject(e, every) for e in (near, far))]
        tangent = torch.stack(slopes)
        if not bool(((tangent > 0) & (tangent < WIDEST)).all()):
            return None
        found.append(float(1 / tangent.mean()))
    return found[0], found[1]
