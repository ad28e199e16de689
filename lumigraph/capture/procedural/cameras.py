"""Where procedural scenes are photographed from: a dome around an object, a walk within a place."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float

from ...camera import Camera
from ...lens import Pinhole

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


def look_at(eye, target, up=(0.0, 0.0, 1.0)) -> Float[np.ndarray, "3 4"]:
    """Pose of a camera at `eye` whose picture's centre is `target` and whose top points `up`."""
    eye, target, up = (np.asarray(x, float) for x in (eye, target, up))
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward, eye], -1)


def pinhole(poses: Float[np.ndarray, "camera 3 4"], size: int, field_of_view: float) -> Camera:
    """Square pictures of `size` pixels, `field_of_view` degrees wide."""
    count, focal = len(poses), 0.5 * size / math.tan(math.radians(field_of_view) / 2)
    lens = Pinhole(torch.full((count, 2), focal), torch.full((count, 2), size / 2))
    return Camera(torch.from_numpy(np.asarray(poses)).float(), lens, torch.full((count, 2), size))


def sphere_point(azimuth: float, elevation: float, radius: float = 1.0) -> np.ndarray:
    """Angles in radians; elevation above the horizon."""
    flat = radius * math.cos(elevation)
    return np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), radius * math.sin(elevation)])


def dome(count: int, radius: float, random: np.random.Generator, lowest: float = 2.0, highest: float = 80.0):
    """Poses on a dome, evenly spread and a little shaken, all looking near the origin. Elevations in degrees."""
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
    """Poses on a path that climbs around the origin in two turns."""
    start = random.uniform(0, 2 * math.pi)
    share = (np.arange(count) + 0.5) / count
    elevation = np.radians(lowest + (highest - lowest) * share)
    return np.stack(
        [
            look_at(sphere_point(start + 4 * math.pi * s, e, radius), np.zeros(3))
            for s, e in zip(share, elevation, strict=True)
        ]
    )
