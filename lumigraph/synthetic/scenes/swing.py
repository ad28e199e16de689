"""A pendulum over a board: a ball on a rod that swings once across, from time 0 to time 1, in a static scene.

Held-out views are spread over the same second. `angle` is the ball's exact position at any time.
"""

import math

import numpy as np

from ..cameras import dome, pinhole, spiral
from ..filming import timed
from ..shapes import Ball, Cuboid, Cylinder
from ..stage import SyntheticStage
from ..textures import Checker, Plain, Sectors, Wood
from ..world import Lamp, Material, Object, Pose, Sky, World

PIVOT = (0.0, 0.0, 0.55)
ROD_LENGTH, MAX_ANGLE = 0.75, 45.0  # scene units from the pivot to the ball's centre; degrees from the plumb line
RED, CREAM, BLUE = (0.78, 0.22, 0.16), (0.95, 0.91, 0.82), (0.14, 0.28, 0.52)

OAK = Material(Wood((0.80, 0.63, 0.42), (0.62, 0.43, 0.26), ring=0.06, seed=1.0), gloss=0.4, roughness=0.5)
STEEL = Material(Plain((0.72, 0.73, 0.75)), roughness=0.3, metal=1.0)


def still() -> tuple[Object, ...]:
    """Board and gallows, the static objects."""
    board = Material(Checker(CREAM, BLUE, size=0.2), gloss=0.6, roughness=0.4)
    posts = (
        Object(Cuboid((0.03, 0.03, 0.60), 0.01), OAK, Pose.at(0, side * 0.42, -0.02), "gallows") for side in (-1.0, 1.0)
    )
    beam = Object(Cuboid((0.03, 0.45, 0.03), 0.01), OAK, Pose.at(0, 0, 0.58), "gallows")
    return (Object(Cuboid((0.9, 0.55, 0.03), 0.01), board, Pose.at(0, 0, -0.65), "board"), *posts, beam)


def angle(time: float) -> float:
    """Degrees from the vertical, towards +x: half a period, from -MAX_ANGLE at time 0 to MAX_ANGLE at time 1."""
    return -MAX_ANGLE * math.cos(math.pi * time)


def world(time: float) -> World:
    """The world at a time in [0, 1]."""
    swung = Pose(PIVOT) @ Pose.about((0.0, 1.0, 0.0), -angle(time))
    stripes = Material(Sectors(RED, CREAM, count=6, cap=0.2), gloss=1.0, roughness=0.25)
    pendulum = (
        Object(Cylinder(0.012, ROD_LENGTH / 2), STEEL, swung @ Pose.at(0, 0, -ROD_LENGTH / 2), "rod"),
        Object(Ball(0.2), stripes, swung @ Pose.at(0, 0, -ROD_LENGTH), "ball"),
    )
    key = Lamp((-2.6, -1.8, 3.2), radius=0.4, power=18.0, colour=(1.0, 0.95, 0.87))
    fill = Lamp((3.0, 0.8, 2.0), radius=0.8, power=4.0, colour=(0.86, 0.93, 1.0))
    sky = Sky((0.84, 0.91, 1.0), (0.95, 0.94, 0.92), (0.70, 0.62, 0.54), light=0.38)
    return World((*still(), *pendulum), (key, fill), sky)


def stage(size: int = 200, views: int = 100, seed: int = 0) -> SyntheticStage:
    """The pendulum from a dome, each photograph at its own time; held-out views climb around it."""
    random = np.random.default_rng(seed)
    held_out = max(views * 2 // 5, 1)
    cameras = {
        "train": timed(pinhole(dome(views, 3.6, random), size, 36.0), random.permutation(np.linspace(0, 1, views))),
        "test": timed(pinhole(spiral(held_out, 3.6, random), size, 36.0), np.linspace(0, 1, held_out)),
    }
    return SyntheticStage(world(0.0), cameras, ((-1.0, -0.6, -0.7), (1.0, 0.6, 0.7)), reach=1.0, near=1.5, moving=world)
