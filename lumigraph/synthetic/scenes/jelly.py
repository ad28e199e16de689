"""A jelly on a board, from time 0 to time 1: its foot stays, its body sways from side to side, stretches and turns.

Its motion is not rigid. `World.carried` gives the path of any surface point.
"""

import math

from ..filming import Filmed, film
from ..shapes import Cuboid, SoftCapsule
from ..stage import SyntheticStage
from ..textures import Checker, Mottle
from ..world import Lamp, Material, Object, Pose, Sky, World

Options = Filmed
RADIUS, HALF_HEIGHT = 0.28, 0.30  # of the jelly at rest, scene units
MAX_BEND, SWAYS = 75.0, 2.0  # degrees from its foot to its top; periods
MAX_STRETCH, STRETCHES = 0.12, 3.0  # share of its height; periods
MAX_TURN = 25.0  # degrees about the vertical
FLOOR = -0.60
CREAM, SLATE = (0.93, 0.89, 0.80), (0.27, 0.36, 0.46)
RED, YELLOW = (0.84, 0.16, 0.12), (0.99, 0.83, 0.36)


def jelly(time: float) -> Object:
    """The body at a time."""
    bend = math.radians(MAX_BEND) * math.sin(2 * math.pi * SWAYS * time)
    stretch = 1.0 + MAX_STRETCH * math.sin(2 * math.pi * STRETCHES * time)
    height = 2 * HALF_HEIGHT * stretch
    shape = SoftCapsule(RADIUS, HALF_HEIGHT, bend / height, stretch)
    x, z, angle = (float(value) for value in shape.axis(-0.5 * height))
    foot = Pose.at(0, 0, FLOOR + RADIUS, turn=MAX_TURN * math.sin(2 * math.pi * time))
    gel = Material(Mottle(RED, YELLOW, size=0.3, contrast=3.0, seed=3.0), gloss=0.5, roughness=0.35)
    return Object(shape, gel, foot @ Pose.about((0, 1, 0), -math.degrees(angle)) @ Pose.at(-x, 0, -z), "jelly")


def world(time: float) -> World:
    """The world at a time in [0, 1]."""
    board = Material(Checker(CREAM, SLATE, size=0.2), gloss=0.6, roughness=0.4)
    key = Lamp((-2.6, -1.8, 3.2), radius=0.5, power=18.0, colour=(1.0, 0.95, 0.87))
    fill = Lamp((3.0, -0.8, 2.0), radius=0.8, power=5.0, colour=(0.86, 0.93, 1.0))
    sky = Sky((0.84, 0.91, 1.0), (0.95, 0.94, 0.92), (0.70, 0.62, 0.54), light=0.42)
    still = Object(Cuboid((0.75, 0.6, 0.05), 0.02), board, Pose.at(0, 0, FLOOR - 0.05), "board")
    return World((still, jelly(time)), (key, fill), sky)


def stage(size: int = 200, views: int = 100, seed: int = 0, rig: int = 0, sweeps: int = 1) -> SyntheticStage:
    bounds = ((-0.95, -0.75, -0.75), (0.95, 0.75, 0.75))
    return SyntheticStage(world(0.0), film(size, views, seed, rig, sweeps), bounds, reach=0.95, near=1.5, moving=world)
