"""Up direction from camera orientations, drones' positions, and sparse points."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float

from ..camera import Camera
from ..geometry import turning

Direction = Float[np.ndarray, " 3"]
Points = Float[np.ndarray, "point 3"]

MIN_UP_COSINE = math.cos(math.radians(15))  # a source axis nearer to up than this is up
MAX_ROW_TILT = 0.03  # mean square of image rows along up where cameras are held level: 10 degrees
# Mean square of image rows across their main direction, if cameras turn about up: 8 degrees; and its ratio to the tilt.
MIN_ROW_TURN, MIN_TURN_RATIO = 0.02, 4
ALONG_COSINE = 0.9  # from which on a camera looks along a direction
MIN_OBLIQUE_SHARE = 0.1  # share of the cameras that must look elsewhere than the rest
MIN_MEAN_UP = 0.5  # length of the pictures' mean up; below it cameras were turned about their axes
MIN_USABLE_UP = 0.2  # length of the mean up below which it is no evidence
MIN_AGREEMENT = 0.7  # cosine between the pictures' mean up and the normal of their rows, if that is up
MIN_MAP_SPREAD = 0.4  # times the distance to the scene: deviation of positions both ways from which on they are a map's
PLANE_SPREAD = 0.2  # of the positions' extent: on a plane the smallest deviation is less, the middle one more
MIN_MAP_COSINE = 0.5  # between a map's plane and the view: drones look no flatter than that


def find_upright(cameras: Camera, points: Points | None = None) -> Float[np.ndarray, "3 3"]:
    """The rotation of the cameras' common up to +z; the identity if the source already has an axis there."""
    up = common_up(cameras, points)
    return np.eye(3) if up is None else upright_by(up)


def upright_by(up: Direction) -> Float[np.ndarray, "3 3"]:
    """The rotation of a direction to +z, or of the axis that is close to it."""
    up = unit(up)
    nearest = np.zeros(3)
    nearest[np.abs(up).argmax()] = np.sign(up[np.abs(up).argmax()])
    if up @ nearest > MIN_UP_COSINE:
        up = nearest
    return turn_onto_z(up)


def common_up(cameras: Camera, points: Points | None = None) -> Direction | None:
    """Up direction of the scene, unit length; None if undetermined.

    Cameras are held level rather than straight ahead, by hand as by a drone's gimbal: up is the direction most
    orthogonal to all pictures' rows. That is undetermined where all rows are parallel, and wrong where cameras that
    look one way were
    also rolled: then up is the pictures' mean up, unless they look down. A drone's positions are in a level plane,
    which determines up where its pictures cannot.

    points: sparse points, in the cameras' frame
    """
    rows, downs, forwards = (cameras.pose[:, :, k].double().numpy() for k in range(3))
    places = cameras.position.double().numpy()
    own, gaze = -downs.mean(0), forwards.mean(0)
    values, vectors = np.linalg.eigh(rows.T @ rows / len(rows))
    level, turning = vectors[:, 0], values[1] > max(MIN_ROW_TURN, MIN_TURN_RATIO * values[0])
    elsewhere = np.quantile(np.abs(forwards @ level), MIN_OBLIQUE_SHARE) < ALONG_COSINE
    if turning and values[0] < MAX_ROW_TILT and elsewhere:
        return upwards(level, own, gaze)
    if (above := from_above(places, own, gaze, points)) is not None:
        return upwards(level, above, gaze) if turning else above
    if np.linalg.norm(own) < MIN_USABLE_UP:
        return upwards(level, own, gaze) if turning else None
    own = unit(own)
    return level * np.sign(level @ own) if turning and abs(level @ own) > MIN_AGREEMENT else own


def from_above(
    places: Float[np.ndarray, "camera 3"], own: Direction, gaze: Direction, points: Points | None
) -> Direction | None:
    """Up direction, unit length, of cameras that look down at a ground; None if they look ahead.

    They look down if they are rotated about their axes, as on a drone's parallel tracks, or if they are spread over the
    ground as for a map. Then the plane of their positions is level.
    own, gaze: mean of the pictures' own up, and of the viewing directions
    """
    if np.linalg.norm(gaze) < ALONG_COSINE:
        return None
    _, sizes, axes = np.linalg.svd(places - places.mean(0), full_matrices=False)
    back, normal = -unit(gaze), axes[-1] * np.sign(-axes[-1] @ gaze)
    flat = sizes[2:].sum() < PLANE_SPREAD * sizes[0] < sizes[1] and normal @ back > MIN_MAP_COSINE
    if np.linalg.norm(own) < MIN_MEAN_UP:
        return normal if flat else back
    if not flat or points is None or not len(points):
        return None
    distance = float(np.median((places.mean(0) - points) @ normal))
    return normal if sizes[1] / math.sqrt(len(places)) > MIN_MAP_SPREAD * distance > 0 else None


def upwards(axis: Direction, own: Direction, gaze: Direction) -> Direction:
    """Sign of an axis towards the pictures' own up; if that is undecided, towards the cameras."""
    side = axis @ own
    return axis * np.sign(side if abs(side) > MIN_USABLE_UP else -axis @ gaze)


def unit(vector: Direction) -> Direction:
    return vector / np.linalg.norm(vector)


def turn_onto_z(up: Direction) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that takes a direction to +z."""
    return turning(torch.from_numpy(np.asarray(up)), torch.tensor([0.0, 0.0, 1.0])).numpy()
