"""A rig for omnidirectional stereo: outward cameras on a level circle, in the study of `room`."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ...files.ranges import between
from ..cameras import look_at, pinhole
from ..stage import Pictures, SyntheticStage
from . import room

RADIUS = 0.054  # of the circle, 14 cm in a room whose unit is 2.6 m
FIELD_OF_VIEW = 110.0  # degrees across


@dataclass(frozen=True)
class Options(Pictures):
    """views: cameras on the circle"""

    size: Annotated[int, between(1, 8192)] = 400
    views: Annotated[int, between(3, 64)] = 12


def stage(size: int = 400, views: int = 12, seed: int = 0) -> SyntheticStage:
    """The rig near the middle of the study; the held-out view is at the rig's centre."""
    around = room.stage(8, 1, seed)
    middle = np.array([0.1, -0.05, 0.0])
    poses = []
    for k in range(views):
        angle = 2 * math.pi * k / views
        outward = np.array([math.cos(angle), math.sin(angle), 0.0])
        poses.append(look_at(middle + RADIUS * outward, middle + (1 + RADIUS) * outward))
    test = np.stack([look_at(middle, middle + np.array([1.0, 0, 0]))])
    cameras = {"train": pinhole(np.stack(poses), size, FIELD_OF_VIEW), "test": pinhole(test, size, FIELD_OF_VIEW)}
    return SyntheticStage(around.world, cameras, around.bounds, reach=around.reach, near=around.near)
