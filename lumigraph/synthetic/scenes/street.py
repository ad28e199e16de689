"""A street, from time 0 to time 1: three figures walk past a house, with swinging arms and legs.

Every limb is rigid, turns about its joint and touches no other. `World.carried` gives the path of any of its points.
"""

import math
from collections.abc import Iterator

from ..filming import Filmed, film
from ..shapes import Ball, Cuboid, SoftCapsule
from ..stage import SyntheticStage
from ..textures import Bricks, Checker, Mottle, Plain, Stripes
from ..world import Lamp, Material, Object, Pose, Sky, World

Options = Filmed
GROUND, WALL = -0.62, 0.42  # height of the pavement, and how far back the house stands
WALK = 1.1  # scene units that a figure walks
LEG, TORSO, ARM, HEAD = 0.30, 0.28, 0.24, 0.075  # lengths of a figure's parts, and the radius of its head
STRIDE, ARM_SWING = 28.0, 24.0  # degrees that a leg and an arm swing to either side
SKIN, CREAM, GREY = (0.82, 0.60, 0.46), (0.93, 0.89, 0.80), (0.52, 0.52, 0.55)
# Of each figure: where it walks (y), the way (1 to the right), where it begins, steps, and the colours of its coat.
FIGURES = (
    (-0.29, 1, -0.55, 2.0, (0.78, 0.16, 0.14), (0.96, 0.84, 0.40)),
    (-0.02, -1, 0.60, 1.5, (0.14, 0.32, 0.62), (0.86, 0.90, 0.94)),
    (0.25, 1, -0.30, 2.5, (0.14, 0.45, 0.30), (0.90, 0.80, 0.55)),
)


def limb(length: float, radius: float) -> tuple[SoftCapsule, Pose]:
    """A straight limb, and its pose below its joint."""
    return SoftCapsule(radius, 0.5 * length, 0.0, 1.0), Pose.at(0, 0, -0.5 * length)


def figure(number: int, time: float) -> Iterator[Object]:
    """A walking figure at a time."""
    depth, way, start, steps, coat, trim = FIGURES[number]
    name, phase = f"figure {number + 1}", 2 * math.pi * steps * time
    cloth = Material(Mottle(coat, trim, size=0.14, contrast=3.0, seed=float(number)), roughness=0.8)
    trousers, skin = (
        Material(Plain((0.5 * coat[0], 0.5 * coat[1], 0.5 * coat[2])), roughness=0.8),
        Material(Plain(SKIN), roughness=0.6),
    )
    rise = 0.012 * math.cos(2 * phase)
    hip = Pose.at(start + way * WALK * time, depth, GROUND + LEG + 0.06 + rise, turn=0.0 if way > 0 else 180.0)
    body, below = limb(TORSO - 0.16, 0.07)
    yield Object(body, cloth, hip @ Pose.at(0, 0, TORSO) @ below, f"{name}'s body")
    yield Object(Ball(HEAD), skin, hip @ Pose.at(0, 0, TORSO + 0.16), f"{name}'s head")
    for side in (-1, 1):
        swing = side * math.sin(phase)
        for part, joint, length, radius, angle, paint in (
            ("leg", (0, 0.045 * side, 0), LEG, 0.042, STRIDE * swing, trousers),
            ("arm", (0, 0.1 * side, TORSO - 0.03), ARM, 0.026, -ARM_SWING * swing, cloth),
        ):
            shape, place = limb(length, radius)
            yield Object(
                shape, paint, hip @ Pose.at(*joint) @ Pose.about((0, 1, 0), angle) @ place, f"{name}'s {part} {side}"
            )


def world(time: float) -> World:
    """The world at a time in [0, 1]."""
    brick = Material(Bricks((0.66, 0.36, 0.28), (0.80, 0.77, 0.72)), roughness=0.9)
    flags = Material(Checker(CREAM, GREY, size=0.22), roughness=0.8)
    door = Material(Stripes((0.20, 0.34, 0.30), (0.26, 0.44, 0.38)), gloss=0.4, roughness=0.5)
    still = (
        Object(Cuboid((0.92, 0.42, 0.03), 0.01), flags, Pose.at(0, 0.0, GROUND - 0.03), "pavement"),
        Object(Cuboid((0.92, 0.04, 0.55), 0.01), brick, Pose.at(0, WALL + 0.04, GROUND + 0.55), "house"),
        Object(Cuboid((0.16, 0.02, 0.32), 0.01), door, Pose.at(0.3, WALL, GROUND + 0.32), "door"),
    )
    walkers = tuple(part for number in range(len(FIGURES)) for part in figure(number, time))
    key = Lamp((-2.2, -2.6, 3.2), radius=0.5, power=19.0, colour=(1.0, 0.95, 0.87))
    fill = Lamp((3.0, -1.4, 2.0), radius=0.8, power=6.0, colour=(0.86, 0.93, 1.0))
    sky = Sky((0.80, 0.89, 1.0), (0.95, 0.94, 0.92), (0.70, 0.64, 0.58), light=0.42)
    return World((*still, *walkers), (key, fill), sky)


def stage(size: int = 200, views: int = 100, seed: int = 0, rig: int = 0, sweeps: int = 1) -> SyntheticStage:
    bounds = ((-0.96, -0.46, -0.72), (0.96, 0.52, 0.5))
    return SyntheticStage(world(0.0), film(size, views, seed, rig, sweeps), bounds, reach=0.96, near=1.5, moving=world)
