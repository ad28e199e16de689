"""Cameras of dynamic scenes, from time 0 to time 1: one moving camera, or a static rig.

Two further static cameras are held out. They alternate between training times and every fourth time between two of
them: one set of views measures the cost of new cameras and of new times.
"""

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch

from ..camera import Camera
from ..files.ranges import between
from .cameras import look_at, pinhole, sphere_point
from .stage import Pictures

FRONT = -90.0  # azimuth from which a scene is filmed, degrees; that of -y
SWEEP, CLIMB = 60.0, 12.0  # degrees to either side of the front, and around the elevation
ELEVATION = 26.0  # degrees
HELD_OUT = (-28.0, 34.0), (24.0, 18.0)  # azimuth from the front and elevation of the held-out cameras, degrees
BETWEEN = 4  # training moments to a held-out one between two of them
FIELD_OF_VIEW = 36.0  # degrees
MIN_MOMENTS = 2


@dataclass(frozen=True)
class Filmed(Pictures):
    """Options of every scene, and of filmed ones.

    views:  photographs of one moving camera, each at its own time, or of all cameras of a rig
    rig:    cameras of a rig, which photograph every time; 0 for one moving camera
    sweeps: number of sweeps of the moving camera to one side, to the other, and back
    """

    rig: Annotated[int, between(0, 100)] = 0
    sweeps: Annotated[int, between(1, 100)] = 1


def film(size: int, views: int, seed: int, rig: int, sweeps: int = 1, radius: float = 3.6) -> dict[str, Camera]:
    """Cameras by split. The moving one sweeps to one side, to the other, and back, 2.4 degrees from one of 100
    photographs to the next, 3.8 at most, times the number of sweeps; the seed shifts its start."""
    random = np.random.default_rng(seed)
    start, aside = random.uniform(0, 2 * math.pi), random.normal(0, 2.0, 2)
    moments = np.linspace(0, 1, max(views // rig, MIN_MOMENTS) if rig else max(views, MIN_MOMENTS))
    if rig:
        places = [(360 * k / rig, ELEVATION + CLIMB * (-1) ** k) for k in range(rig)]
        train = [(*places[k], t) for t in moments for k in range(rig)]
    else:
        turns = start + 2 * math.pi * sweeps * moments
        across, up = SWEEP * np.sin(turns), ELEVATION + CLIMB * np.cos(2 * turns)
        train = list(zip(across, up, moments, strict=True))
    halfway = 0.5 * (moments[:-1] + moments[1:])[BETWEEN // 2 :: BETWEEN]
    seen = np.sort(np.concatenate([moments, halfway]))
    test = [(*HELD_OUT[k % 2], t) for k, t in enumerate(seen)]
    return {name: taken(stops, size, radius, aside) for name, stops in (("train", train), ("test", test))}


def taken(stops: list, size: int, radius: float, aside: np.ndarray) -> Camera:
    """Cameras that look at the origin. stops: azimuth from the front and elevation, degrees, and time of each; aside:
    azimuth offset of all, degrees"""
    around, up = np.radians([(FRONT + azimuth + aside[0], elevation + aside[1]) for azimuth, elevation, _ in stops]).T
    poses = np.stack([look_at(sphere_point(a, b, radius), np.zeros(3)) for a, b in zip(around, up, strict=True)])
    return timed(pinhole(poses, size, FIELD_OF_VIEW), np.array([stop[2] for stop in stops]))


def timed(cameras: Camera, times: np.ndarray) -> Camera:
    """Cameras with these times of exposure."""
    return replace(cameras, time=torch.from_numpy(times).float())
