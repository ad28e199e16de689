"""Columns around a lamp, in fog that scatters its light once: beams between shadows, a glow around the lamp.

`lamp` is the lamp's azimuth in degrees, `anisotropy` the asymmetry g of the phase function in hundredths, `thickness`
the extinction in hundredths per scene unit. Nothing else lights the scene.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ...files.ranges import between
from ..cameras import dome, pinhole, spiral
from ..shapes import Ball, Cuboid, Cylinder
from ..stage import Pictures, SyntheticStage
from ..textures import Checker, Plain, Rings
from ..world import Fog, Lamp, Material, Object, Pose, Sky, World

RADIUS, FIELD_OF_VIEW = 3.0, 46.0  # of the cameras' dome, scene units and degrees
LAMP_ORBIT, LAMP_HEIGHT, LAMP_POWER = 0.42, 0.18, 0.8
ALBEDO = 0.9  # sigma_s over sigma_t
REACH = 1.15  # radius of the fog


@dataclass(frozen=True)
class Options(Pictures):
    """lamp: azimuth, degrees; anisotropy: 100 g of the phase function; thickness: 100 sigma_t per scene unit"""

    lamp: Annotated[int, between(0, 359)] = 0
    anisotropy: Annotated[int, between(0, 95)] = 60
    thickness: Annotated[int, between(1, 1000)] = 80


def world(lamp: float = 0.0, anisotropy: float = 0.6, thickness: float = 0.8) -> World:
    """Five columns on a round floor, a ball in their middle, and the lamp at an azimuth."""
    stone = Material(Plain((0.80, 0.77, 0.70)))
    rings = Material(Rings((0.72, 0.40, 0.28), (0.85, 0.80, 0.70), period=0.12))
    floor = Material(Checker((0.75, 0.72, 0.66), (0.42, 0.44, 0.50), size=0.22))
    columns = (
        Object(Cylinder(0.06, 0.36), stone, Pose.at(0.72 * math.cos(a), 0.72 * math.sin(a), -0.09), "columns")
        for a in (math.radians(72 * k + 20) for k in range(5))
    )
    objects = (
        Object(Cylinder(0.95, 0.04), floor, Pose.at(0, 0, -0.49), "floor"),
        *columns,
        Object(Ball(0.17), rings, Pose.at(0, 0, -0.28), "ball"),
        Object(Cuboid((0.16, 0.05, 0.22)), stone, Pose.at(-0.35, -0.38, -0.23, turn=35), "stone"),
    )
    angle = math.radians(lamp)
    place = (LAMP_ORBIT * math.cos(angle), LAMP_ORBIT * math.sin(angle), LAMP_HEIGHT)
    lights = (Lamp(place, radius=0.03, power=LAMP_POWER, colour=(1.0, 0.93, 0.82)),)
    black = (0.0, 0.0, 0.0)
    fog = Fog(ALBEDO * thickness, (1 - ALBEDO) * thickness, anisotropy, REACH)
    return World(objects, lights, Sky(black, black, black, visible=True), fog=fog)


def stage(
    size: int = 200, views: int = 100, seed: int = 0, lamp: int = 0, anisotropy: int = 60, thickness: int = 80
) -> SyntheticStage:
    """Training views from a dome outside the fog; held-out ones climb around it."""
    random = np.random.default_rng(seed)
    held_out = max(views * 2 // 5, 1)
    return SyntheticStage(
        world(lamp, anisotropy / 100, thickness / 100),
        {
            "train": pinhole(dome(views, RADIUS, random), size, FIELD_OF_VIEW),
            "test": pinhole(spiral(held_out, RADIUS, random), size, FIELD_OF_VIEW),
        },
        ((-1.0, -1.0, -0.55), (1.0, 1.0, 0.75)),
        reach=1.0,
        near=1.2,
    )
