"""Camera positions of procedural scenes: a dome around an object, a walk within a place."""

import math

import numpy as np
import torch
from jaxtyping import Float

from .. import geometry
from ..camera import Camera
from ..camera.lens import Pinhole

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


def look_at(eye, target, up=(0.0, 0.0, 1.0)) -> Float[np.ndarray, "3 4"]:
    """Pose of a camera at `eye` looking at `target`, with `up` upwards in its picture."""
    eye, target, up = (torch.as_tensor(np.asarray(x, np.float64)) for x in (eye, target, up))
    return geometry.look_at(eye, target - eye, up).numpy()


def pinhole(
    poses: Float[np.ndarray, "camera 3 4"], size: int | tuple[int, int], field_of_view: float | np.ndarray
) -> Camera:
    """Cameras with pinhole lenses. size: (width, height) or side in pixels; field_of_view: degrees, of all or each"""
    count = len(poses)
    shape = torch.tensor([size, size] if isinstance(size, int) else size)
    angles = np.broadcast_to(np.radians(field_of_view), count)
    focal = torch.from_numpy(0.5 * int(shape[0]) / np.tan(angles / 2)).float()[:, None].expand(-1, 2)
    lens = Pinhole(focal, (shape / 2).expand(count, 2).contiguous())
    return Camera(torch.from_numpy(np.asarray(poses)).float(), lens, shape.expand(count, 2).contiguous())


def sphere_point(azimuth: float, elevation: float, radius: float = 1.0) -> np.ndarray:
    """A point of the unit sphere. Angles in radians; elevation above the horizon."""
    flat = radius * math.cos(elevation)
    return np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), radius * math.sin(elevation)])


def dome(count: int, radius: float, random: np.random.Generator, lowest: float = 2.0, highest: float = 80.0):
    """Poses on a dome, evenly spread with jitter, looking near the origin. Elevations in degrees."""
    low, high = math.sin(math.radians(lowest)), math.sin(math.radians(highest))
    start, poses = random.uniform(0, 2 * math.pi), []
    order = random.permutation(count)  # any first few views should surround the object, too
    for k in order:
        height = low + (high - low) * (k + random.uniform(0.1, 0.9)) / count
        azimuth = start + GOLDEN_ANGLE * k + random.normal(0, 0.05)
        distance = radius * random.uniform(0.95, 1.05)
        poses.append(look_at(sphere_point(azimuth, math.asin(height), distance), random.normal(0, 0.02, 3)))
    return np.stack(poses)


def spiral(count: int, radius: float, random: np.random.Generator, lowest: float = 12.0, highest: float = 60.0):
    """Poses on a spiral that climbs around the origin in two turns."""
    start, poses = random.uniform(0, 2 * math.pi), []
    for share in (np.arange(count) + 0.5) / count:
        elevation = math.radians(lowest + (highest - lowest) * share)
        poses.append(look_at(sphere_point(start + 4 * math.pi * share, elevation, radius), np.zeros(3)))
    return np.stack(poses)


def walk(count: int, inner: float, outer: float, random: np.random.Generator):
    """Poses on a ring around the origin at eye height, alternately looking inward and outward."""
    start, poses = random.uniform(0, 2 * math.pi), []
    for k in range(count):
        azimuth = start + GOLDEN_ANGLE * k + random.normal(0, 0.05)
        eye = sphere_point(azimuth, 0.0, random.uniform(inner, outer)) + (0, 0, random.uniform(-0.12, 0.16))
        inward = math.pi if k % 2 == 0 else 0.0
        gaze = sphere_point(azimuth + inward + random.uniform(-0.7, 0.7), math.radians(random.uniform(-14, 10)))
        poses.append(look_at(eye, eye + gaze))
    return np.stack(poses)


def stroll(count: int, radius: float, random: np.random.Generator):
    """Poses once around the origin, with the viewing direction turning twice."""
    start, poses = random.uniform(0, 2 * math.pi), []
    for share in (np.arange(count) + 0.5) / count:
        azimuth = start + 2 * math.pi * share
        eye = sphere_point(azimuth, 0.0, radius) + (0, 0, 0.08 * math.sin(6 * math.pi * share))
        gaze = sphere_point(azimuth + math.pi + 1.2 * math.sin(8 * math.pi * share), math.radians(-3.0))
        poses.append(look_at(eye, eye + (gaze if share < 0.5 else gaze * (-1, -1, 1))))
    return np.stack(poses)


def hand_held(count: int, half_axes: tuple[float, float], random: np.random.Generator, loops: float = 1.05):
    """Poses of a hand-held camera around the origin, looking outward: translation, rotation, tremor, a loop.

    half_axes: of the elliptic path, scene units
    loops:     times around; above 1 the end overlaps the beginning
    """
    start, phase = random.uniform(0, 2 * math.pi), random.uniform(0, 2 * math.pi, (6, 3))
    poses = []
    for share in np.arange(count) / max(count - 1, 1) * loops:
        turn = 2 * math.pi * share
        # Whole numbers of waves in one loop, so that its end meets its beginning.
        bob = np.sin(3 * turn + phase[0]) * (0.03, 0.03, 0.05)
        tremor = 0.002 * (np.sin(37 * turn + phase[1]) + np.sin(53 * turn + phase[2]))
        eye = np.array([half_axes[0] * math.cos(start + turn), half_axes[1] * math.sin(start + turn), 0.0])
        swing, nod, roll = np.sin(turn * np.array([2, 5, 4]) + phase[3]) * (0.35, 0.45, 0.08)
        shake = 0.004 * np.sin(41 * turn + phase[4])
        gaze = sphere_point(start + turn + swing + shake[0], nod - 0.12 + shake[1])
        up = (math.sin(roll) * math.sin(start + turn), -math.sin(roll) * math.cos(start + turn), math.cos(roll))
        poses.append(look_at(eye + bob + tremor, eye + bob + tremor + gaze, up))
    return np.stack(poses)
