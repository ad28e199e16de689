"""A façade on a square, as tourists photograph it: varying weather, lenses and colours, with people and cars as
transient occluders. Held-out photographs have a light of their own too, without occluders.

A unit is some six metres; z = 0 is at eye height, the façade faces -y.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

from ...camera import Camera
from ..cameras import look_at, pinhole
from ..shapes import Arch, Ball, Cone, Cuboid, Cylinder, Plane, Torus
from ..stage import SyntheticStage
from ..textures import Bricks, Checker, Colour, Mottle, Plain, Stripes
from ..world import Material, Object, Pose, Sky, Sun, World

GROUND = -0.28  # eye height above the square
WALL = 0.55  # where the façade stands
STONE = Material(Bricks((0.86, 0.78, 0.64), (0.62, 0.55, 0.45), length=0.16, height=0.07, joint=0.008, variation=0.14))
TRIM = Material(Mottle((0.93, 0.90, 0.83), (0.76, 0.72, 0.64), size=0.10, contrast=0.8))
PLASTER = Material(Mottle((0.83, 0.52, 0.38), (0.73, 0.43, 0.30), size=0.30, contrast=0.8, seed=2.0))
ROOF = Material(Stripes((0.46, 0.50, 0.53), (0.34, 0.37, 0.41), period=0.06, share=0.3))
DOOR = Material(Stripes((0.24, 0.36, 0.30), (0.15, 0.24, 0.20), period=0.05, share=0.4), gloss=0.4, roughness=0.5)
GLASS = Material(Plain((0.12, 0.16, 0.22)), gloss=1.0, roughness=0.2)
BRONZE = Material(Mottle((0.36, 0.50, 0.42), (0.22, 0.33, 0.28), size=0.06, contrast=1.2), gloss=0.4, roughness=0.5)
PAVING = Material(Checker((0.72, 0.68, 0.62), (0.56, 0.52, 0.47), size=0.20))
LEAVES = Material(Mottle((0.38, 0.52, 0.22), (0.16, 0.28, 0.11), size=0.10, contrast=1.3))
SKIN = Material(Plain((0.85, 0.66, 0.54)))
TYRE = Material(Plain((0.10, 0.10, 0.11)))

CLOTHES = (
    (0.80, 0.16, 0.15), (0.13, 0.25, 0.55), (0.95, 0.83, 0.22), (0.92, 0.92, 0.90),
    (0.16, 0.45, 0.30), (0.10, 0.10, 0.13), (0.88, 0.45, 0.60), (0.35, 0.70, 0.82),
)  # fmt: skip
PAINTS = ((0.72, 0.10, 0.12), (0.85, 0.86, 0.88), (0.12, 0.18, 0.35), (0.93, 0.78, 0.15), (0.15, 0.16, 0.17))

MAX_PASSERS = 5  # people and cars in one photograph
MIN_DISTANCE, MAX_DISTANCE = 1.5, 2.3  # cameras from the façade's centre
MAX_AZIMUTH = 42.0  # degrees to either side


@dataclass(frozen=True)
class Day:
    """Light and camera settings of one photograph.

    sun:      degrees (azimuth from the façade's front, elevation)
    overcast: share of the sun that clouds block
    balance:  factors on red, green and blue
    exposure: factor on all light
    """

    sun: tuple[float, float]
    overcast: float
    balance: Colour
    exposure: float

    @staticmethod
    def sample(random: np.random.Generator) -> Day:
        """Random light: morning to evening, clear or overcast, warm or cold, one stop of exposure in all."""
        warm, tint = random.normal(0, 0.13), random.normal(0, 0.03)
        return Day(
            (random.uniform(-75, 75), random.uniform(15, 65)),
            float(random.choice([0.0, 0.3, 0.8], p=[0.5, 0.3, 0.2])),
            (math.exp(warm), math.exp(tint), math.exp(-warm)),
            2 ** random.uniform(-0.6, 0.4),
        )

    @property
    def lights(self) -> tuple[Sun]:
        """The sun: warmer near the horizon."""
        azimuth, elevation = (math.radians(x) for x in self.sun)
        low = 1 - math.sin(elevation)
        colour = (1.0, 0.95 - 0.20 * low, 0.86 - 0.42 * low)
        toward = (
            math.sin(azimuth) * math.cos(elevation),
            -math.cos(azimuth) * math.cos(elevation),
            math.sin(elevation),
        )
        return (Sun(toward, radius=0.012, power=0.95 * (1 - self.overcast), colour=colour),)

    @property
    def sky(self) -> Sky:
        def between(clear: Colour, dull: Colour) -> Colour:
            r, g, b = (a + self.overcast * (c - a) for a, c in zip(clear, dull, strict=True))
            return r, g, b

        return Sky(
            between((0.30, 0.52, 0.86), (0.72, 0.74, 0.77)),
            between((0.80, 0.88, 0.95), (0.82, 0.83, 0.84)),
            (0.60, 0.56, 0.50),
            light=0.60 + 0.25 * self.overcast,
            visible=True,
            clouds=0.4,
            haze=0.01,
            reach=0.3,
            exposure=self.exposure,
            balance=self.balance,
        )


def tower(x: float) -> Iterator[Object]:
    yield Object(Cuboid((0.22, 0.22, 0.62)), STONE, Pose.at(x, WALL, GROUND + 0.62), "tower")
    yield Object(Cuboid((0.25, 0.25, 0.03), 0.01), TRIM, Pose.at(x, WALL, GROUND + 1.26), "tower")
    yield Object(Cone(0.27, 0.0, 0.24), ROOF, Pose.at(x, WALL, GROUND + 1.53), "tower")
    for z in (0.40, 0.85):
        yield Object(Cuboid((0.07, 0.01, 0.12)), GLASS, Pose.at(x, WALL - 0.225, GROUND + z), "tower")
        yield Object(Cuboid((0.10, 0.03, 0.015)), TRIM, Pose.at(x, WALL - 0.23, GROUND + z - 0.14), "tower")


def front() -> Iterator[Object]:
    """The wall between the towers: gates, windows, cornices, a gable with a round window."""
    yield Object(Cuboid((0.72, 0.10, 0.46)), PLASTER, Pose.at(0, WALL + 0.06, GROUND + 0.46), "front")
    yield Object(Cuboid((0.74, 0.14, 0.03), 0.01), TRIM, Pose.at(0, WALL + 0.05, GROUND + 0.94), "front")
    yield Object(Cuboid((0.72, 0.13, 0.02), 0.006), TRIM, Pose.at(0, WALL + 0.05, GROUND + 0.50), "front")
    gable = Pose.at(0, WALL + 0.06, GROUND + 0.96) @ Pose.about((0, 1, 0), 45)
    yield Object(Cuboid((0.30, 0.09, 0.30)), PLASTER, gable, "front")
    yield Object(Torus(0.09, 0.02), TRIM, Pose.at(0, WALL - 0.03, GROUND + 1.12, tilt=90), "windows")
    yield Object(Cylinder(0.085, 0.012), GLASS, Pose.at(0, WALL - 0.03, GROUND + 1.12, tilt=90), "windows")
    for x in (-0.44, 0.0, 0.44):
        gate = Arch((0.19, 0.08, 0.23), 0.11, spring=0.24)
        yield Object(gate, STONE, Pose.at(x, WALL - 0.10, GROUND + 0.23), "gates")
        yield Object(Cuboid((0.12, 0.01, 0.20)), DOOR, Pose.at(x, WALL - 0.045, GROUND + 0.20), "gates")
        yield Object(Cuboid((0.08, 0.01, 0.13)), GLASS, Pose.at(x, WALL - 0.045, GROUND + 0.70), "windows")
        yield Object(Cuboid((0.11, 0.035, 0.015)), TRIM, Pose.at(x, WALL - 0.06, GROUND + 0.555), "windows")
        yield Object(Cuboid((0.11, 0.035, 0.02)), TRIM, Pose.at(x, WALL - 0.06, GROUND + 0.85), "windows")
    for x in (-0.63, -0.22, 0.22, 0.63):
        yield Object(Cylinder(0.03, 0.19), TRIM, Pose.at(x, WALL - 0.07, GROUND + 0.70), "columns")


def square() -> Iterator[Object]:
    """Paving, steps, a statue on its pedestal, trees in tubs, houses behind."""
    yield Object(Plane(), PAVING, Pose.at(0, 0, GROUND), "square")
    for i in range(3):
        step = Cuboid((0.80 + 0.06 * i, 0.05, 0.012), 0.004)
        yield Object(step, TRIM, Pose.at(0, WALL - 0.22 - 0.09 * i, GROUND + 0.012 * (3 - i)), "steps")
    yield Object(Cuboid((0.11, 0.11, 0.11), 0.01), STONE, Pose.at(-0.36, -0.10, GROUND + 0.11), "statue")
    yield Object(Cuboid((0.13, 0.13, 0.02), 0.008), TRIM, Pose.at(-0.36, -0.10, GROUND + 0.23), "statue")
    yield Object(Cone(0.075, 0.05, 0.10, 0.01), BRONZE, Pose.at(-0.36, -0.10, GROUND + 0.35), "statue")
    yield Object(Cylinder(0.065, 0.06, 0.03), BRONZE, Pose.at(-0.36, -0.10, GROUND + 0.47), "statue")
    yield Object(Ball(0.045), BRONZE, Pose.at(-0.36, -0.10, GROUND + 0.565), "statue")
    yield Object(Cylinder(0.018, 0.09, 0.008), BRONZE, Pose.at(-0.28, -0.12, GROUND + 0.51, tilt=35), "statue")
    for x in (-0.85, 0.62, 0.95):
        yield Object(Cone(0.07, 0.09, 0.08), STONE, Pose.at(x, 0.02, GROUND + 0.08), "trees")
        yield Object(Torus(0.09, 0.012), TRIM, Pose.at(x, 0.02, GROUND + 0.16), "trees")
        yield Object(Ball(0.15), LEAVES, Pose.at(x, 0.02, GROUND + 0.30, turn=70 * x), "trees")
    for x, height in ((-2.4, 0.75), (2.3, 0.9), (-4.3, 1.0), (4.4, 0.8)):
        house = STONE if height < 0.85 else PLASTER
        yield Object(Cuboid((0.80, 0.5, height)), house, Pose.at(x, 1.4, GROUND + height), "houses")
        yield Object(Cuboid((0.86, 0.55, 0.04)), ROOF, Pose.at(x, 1.4, GROUND + 2 * height + 0.03), "houses")


def person(place: Pose, shirt: Colour, trousers: Colour) -> Iterator[Object]:
    """A standing person, 0.29 units tall."""
    for side in (-0.022, 0.022):
        legs = Cylinder(0.02, 0.065, 0.008)
        yield Object(legs, Material(Plain(trousers)), place @ Pose.at(side, 0, 0.065), "passers-by")
        yield Object(Cylinder(0.014, 0.055, 0.008), SKIN, place @ Pose.at(2.6 * side, 0, 0.175), "passers-by")
    yield Object(Cone(0.036, 0.052, 0.055, 0.015), Material(Plain(shirt)), place @ Pose.at(0, 0, 0.18), "passers-by")
    yield Object(Ball(0.027), SKIN, place @ Pose.at(0, 0, 0.262), "passers-by")


def car(place: Pose, paint: Colour) -> Iterator[Object]:
    """A car along x, 0.7 units long."""
    body = Material(Plain(paint), gloss=1.0, roughness=0.2)
    yield Object(Cuboid((0.35, 0.14, 0.055), 0.03), body, place @ Pose.at(0, 0, 0.10), "passers-by")
    yield Object(Cuboid((0.18, 0.12, 0.05), 0.03), GLASS, place @ Pose.at(-0.02, 0, 0.185), "passers-by")
    yield Object(Cuboid((0.16, 0.115, 0.01), 0.008), body, place @ Pose.at(-0.02, 0, 0.235), "passers-by")
    for x in (-0.21, 0.21):
        wheel = Pose.at(x, 0, 0.05, tilt=90)
        yield Object(Cylinder(0.05, 0.145, 0.01), TYRE, place @ wheel, "passers-by")


def passing(camera: Camera, random: np.random.Generator) -> Iterator[Object]:
    """Transient occluders: people and occasionally a car between a camera and the façade, spread over it."""
    eye = camera.position[0].numpy()
    for _ in range(random.integers(1, MAX_PASSERS + 1)):
        aim = np.array([random.uniform(-0.9, 0.9), WALL])
        drives = random.uniform() < 0.15
        way = random.uniform(0.45 if drives else 0.25, 0.65)  # from the camera to the façade
        x, y = (1 - way) * eye[:2] + way * aim
        if drives:
            paint = PAINTS[random.integers(len(PAINTS))]
            yield from car(Pose.at(x, y, GROUND, turn=random.normal(0, 12)), paint)
        else:
            shirt, trousers = (CLOTHES[i] for i in random.integers(len(CLOTHES), size=2))
            yield from person(Pose.at(x, y, GROUND, turn=random.uniform(0, 360)), shirt, trousers)


def visits(count: int, random: np.random.Generator, size: int) -> Camera:
    """Cameras of visitors who look at the façade from the square, with lenses of 45 to 70 degrees."""
    poses = []
    for _ in range(count):
        azimuth = math.radians(random.uniform(-MAX_AZIMUTH, MAX_AZIMUTH))
        distance = random.uniform(MIN_DISTANCE, MAX_DISTANCE)
        eye = (distance * math.sin(azimuth), WALL - distance * math.cos(azimuth), random.normal(0, 0.03))
        aim = (random.uniform(-0.35, 0.35), WALL, random.uniform(0.05, 0.45))
        poses.append(look_at(eye, aim))
    return pinhole(np.stack(poses), size, random.uniform(45, 70, count))


def world(day: Day, others: tuple[Object, ...] = ()) -> World:
    """The square on a day, with occluders. Mask numbers are the same without them."""
    return World((*front(), *tower(-0.94), *tower(0.94), *square(), *others), day.lights, day.sky)


def photographed(seed: int, cameras: Camera, lasting: bool, index: int) -> World:
    """The world in a photograph. lasting: without transient objects"""
    random = np.random.default_rng([seed, index])
    day = Day.sample(random)
    return world(day, () if lasting else tuple(passing(cameras[index], random)))


def stage(size: int = 200, views: int = 100, seed: int = 0) -> SyntheticStage:
    """The façade by `views` visitors; a quarter as many photographs, without occluders, are held out."""
    held_out = max(views // 4, 1)
    cameras = visits(views + held_out, np.random.default_rng(seed), size)
    cameras = replace(cameras, image_index=torch.arange(len(cameras)))
    empty = partial(photographed, seed, cameras, True)
    crowded = partial(photographed, seed, cameras, False)
    return SyntheticStage(
        world(Day((30.0, 45.0), 0.0, (1.0, 1.0, 1.0), 1.0)),
        {"train": cameras[:views], "test": cameras[views:]},
        ((-1.0, -0.6, GROUND), (1.0, 1.0, 1.2)),
        reach=8.0,
        near=0.15,
        differing=lambda i: empty(i) if i >= views else crowded(i),
        lasting=empty,
    )
