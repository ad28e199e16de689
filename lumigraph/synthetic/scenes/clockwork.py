"""A clockwork in front of a board, from time 0 to time 1: two wheels in gear, a hand and a pendulum, all of them rigid.

The wheels turn by their gear ratio, and the pendulum swings. `World.carried` gives the path of any surface point.
"""

import math
from collections.abc import Iterator

from ..filming import Filmed, film
from ..shapes import Ball, Cuboid, Cylinder
from ..stage import SyntheticStage
from ..textures import Mottle, Plain, Sectors, Wood
from ..world import Lamp, Material, Object, Pose, Sky, World

Options = Filmed
TEETH, MODULE = (12, 9), 0.05  # of the two wheels; radius to a tooth, scene units
TURN = 150.0  # degrees of the first wheel
HAND_TURN = -200.0  # degrees
MAX_ANGLE, SWINGS = 38.0, 1.5  # degrees from the plumb line; periods
ROD_LENGTH = 0.5  # from the pivot to the bob's centre
CREAM, GREEN, RUST, BLUE = (0.94, 0.90, 0.80), (0.16, 0.44, 0.36), (0.75, 0.33, 0.15), (0.16, 0.30, 0.58)

OAK = Material(Wood((0.80, 0.63, 0.42), (0.62, 0.43, 0.26), ring=0.07, seed=2.0), gloss=0.4, roughness=0.5)
STEEL = Material(Plain((0.72, 0.73, 0.75)), roughness=0.35, metal=1.0)


def about_front(x: float, y: float, z: float, degrees: float) -> Pose:
    """A position with a rotation about the axis to the front, anticlockwise as seen from there."""
    return Pose((x, y, z)) @ Pose.about((0.0, -1.0, 0.0), degrees)


def wheel(name: str, teeth: int, hub: Pose, paint: Material) -> Iterator[Object]:
    """A toothed disc, in the plane of x and z."""
    radius = MODULE * (0.5 * teeth - 0.5)
    yield Object(Cylinder(radius, 0.05, 0.01), paint, hub @ Pose.about((1, 0, 0), 90), name)
    for k in range(teeth):
        tooth = Pose.about((0, -1, 0), 360 * k / teeth) @ Pose((0, 0, radius + 0.5 * MODULE - 0.01))
        yield Object(Cuboid((0.4 * MODULE, 0.045, 0.5 * MODULE + 0.01), 0.008), paint, hub @ tooth, name)


def world(time: float) -> World:
    """The world at a time in [0, 1]."""
    first, second = TEETH
    turn = TURN * time
    apart = 0.5 * MODULE * (first + second) + 0.5 * MODULE
    large, small = (
        about_front(-0.24, -0.08, 0.22, turn),
        about_front(apart - 0.24, -0.08, 0.22, -turn * first / second + 180 / second),
    )
    hand = about_front(-0.24, -0.17, 0.22, HAND_TURN * time)
    pendulum = about_front(0.05, -0.16, -0.02, MAX_ANGLE * math.cos(2 * math.pi * SWINGS * time))
    green = Material(Sectors(GREEN, CREAM, count=3), gloss=0.5, roughness=0.4)
    rust = Material(Mottle(RUST, CREAM, size=0.25, contrast=3.0, seed=1.0), gloss=0.5, roughness=0.4)
    blue = Material(Sectors(BLUE, CREAM, count=4, cap=0.11), gloss=0.8, roughness=0.3)
    parts = (
        Object(Cuboid((0.72, 0.04, 0.62), 0.02), OAK, Pose.at(0, 0.06, 0), "board"),
        Object(Cuboid((0.72, 0.30, 0.04), 0.02), OAK, Pose.at(0, -0.2, -0.66), "board"),
        *wheel("large wheel", first, large, green),
        *wheel("small wheel", second, small, rust),
        Object(Cuboid((0.025, 0.02, 0.17), 0.01), STEEL, hand @ Pose((0, 0, 0.12)), "hand"),
        Object(Cylinder(0.014, 0.5 * ROD_LENGTH), STEEL, pendulum @ Pose((0, 0, -0.5 * ROD_LENGTH)), "pendulum"),
        Object(Ball(0.15), blue, pendulum @ Pose((0, 0, -ROD_LENGTH)), "pendulum"),
    )
    key = Lamp((-2.2, -2.4, 3.0), radius=0.5, power=19.0, colour=(1.0, 0.95, 0.87))
    fill = Lamp((3.0, -1.2, 1.8), radius=0.8, power=5.0, colour=(0.86, 0.93, 1.0))
    sky = Sky((0.84, 0.91, 1.0), (0.95, 0.94, 0.92), (0.70, 0.62, 0.54), light=0.42)
    return World(parts, (key, fill), sky)


def stage(size: int = 200, views: int = 100, seed: int = 0, rig: int = 0, sweeps: int = 1) -> SyntheticStage:
    bounds = ((-0.8, -0.55, -0.75), (0.8, 0.15, 0.7))
    return SyntheticStage(world(0.0), film(size, views, seed, rig, sweeps), bounds, reach=0.8, near=1.5, moving=world)
