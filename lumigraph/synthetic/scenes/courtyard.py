"""A southern courtyard: an unbounded scene seen from inside. A unit is some four metres; z = 0 is at eye height."""

import numpy as np

from ..cameras import pinhole, stroll, walk
from ..shapes import Arch, Ball, Cone, Cuboid, Cylinder, Plane, Torus
from ..stage import SyntheticStage
from ..textures import Bricks, Mottle, Plain, Stripes, Wood
from ..world import Material, Object, Pose, Sky, Sun, World

FLOOR = -0.40

SANDSTONE = Material(
    Bricks((0.86, 0.76, 0.60), (0.66, 0.57, 0.45), length=0.20, height=0.09, joint=0.010, variation=0.13)
)
STONE = Material(Mottle((0.88, 0.84, 0.76), (0.70, 0.65, 0.57), size=0.12, contrast=0.8))
PAVING = Material(Bricks((0.78, 0.70, 0.60), (0.50, 0.44, 0.37), length=0.30, height=0.30, joint=0.014, variation=0.20))
OCHRE = Material(Mottle((0.91, 0.70, 0.43), (0.82, 0.58, 0.33), size=0.35, contrast=0.8, seed=1.0))
ROSE = Material(Mottle((0.87, 0.62, 0.52), (0.78, 0.52, 0.42), size=0.35, contrast=0.8, seed=2.0))
TILES = Material(Stripes((0.76, 0.40, 0.26), (0.55, 0.26, 0.17), period=0.075, share=0.3))
TERRACOTTA = Material(Mottle((0.78, 0.45, 0.30), (0.66, 0.35, 0.23), size=0.10, seed=3.0), gloss=0.3, roughness=0.5)
SHUTTER = Material(Stripes((0.25, 0.46, 0.50), (0.17, 0.34, 0.38), period=0.035, share=0.35), gloss=0.3, roughness=0.5)
TIMBER = Material(Wood((0.50, 0.34, 0.22), (0.32, 0.20, 0.12), ring=0.05, seed=2.0))
LEAVES = Material(Mottle((0.40, 0.52, 0.22), (0.17, 0.28, 0.12), size=0.11, contrast=1.3))
CYPRESS = Material(Mottle((0.25, 0.36, 0.20), (0.10, 0.18, 0.11), size=0.16, contrast=1.3, seed=4.0))
GRASS = Material(Mottle((0.66, 0.63, 0.36), (0.44, 0.48, 0.24), size=1.6, contrast=1.2))
WATER = Material(Plain((0.16, 0.36, 0.40)), gloss=1.0, roughness=0.2)


def fountain():
    yield Object(Cylinder(0.37, 0.09, rounding=0.01), STONE, Pose.at(0, 0, FLOOR + 0.09), "fountain")
    yield Object(Torus(0.36, 0.035), STONE, Pose.at(0, 0, FLOOR + 0.185), "fountain")
    yield Object(Cylinder(0.345, 0.004), WATER, Pose.at(0, 0, FLOOR + 0.184), "fountain")
    yield Object(Cylinder(0.045, 0.14), STONE, Pose.at(0, 0, FLOOR + 0.30), "fountain")
    yield Object(Torus(0.05, 0.022), STONE, Pose.at(0, 0, FLOOR + 0.23), "fountain")
    yield Object(Cone(0.06, 0.20, 0.045, rounding=0.01), STONE, Pose.at(0, 0, FLOOR + 0.46), "fountain")
    yield Object(Cylinder(0.18, 0.004), WATER, Pose.at(0, 0, FLOOR + 0.503), "fountain")
    yield Object(Cone(0.045, 0.02, 0.05, rounding=0.01), STONE, Pose.at(0, 0, FLOOR + 0.55), "fountain")
    yield Object(Ball(0.05), STONE, Pose.at(0, 0, FLOOR + 0.63), "fountain")


def arcade(y: float):
    for i in range(5):
        x = 0.86 * (i - 2)
        gate = Arch((0.43, 0.09, 0.60), 0.31, spring=0.62)
        yield Object(gate, SANDSTONE, Pose.at(x, y, FLOOR + 0.60), "arcade")
    for i in range(6):
        x = 0.86 * (i - 2.5)
        yield Object(Cuboid((0.15, 0.12, 0.03), 0.008), STONE, Pose.at(x, y, FLOOR + 0.62), "arcade")
        yield Object(Cuboid((0.15, 0.12, 0.04), 0.008), STONE, Pose.at(x, y, FLOOR + 0.04), "arcade")
    yield Object(Cuboid((2.20, 0.13, 0.04), 0.01), STONE, Pose.at(0, y, FLOOR + 1.23), "arcade")
    yield Object(Cuboid((2.25, 0.03, 0.62)), TILES, Pose.at(0, y + 0.42, FLOOR + 1.49, tilt=-62), "arcade")
    yield Object(Cuboid((2.20, 0.05, 0.90)), ROSE, Pose.at(0, y + 0.95, FLOOR + 0.90), "arcade")


def house(place: Pose):
    def at(x, y, z, **turned):
        return place @ Pose.at(x, y, z, **turned)

    yield Object(Cuboid((1.10, 0.55, 0.72)), OCHRE, at(0, 0, 0.72), "house")
    for side in (-1, 1):
        yield Object(Cuboid((1.20, 0.03, 0.40)), TILES, at(0, -0.32 * side, 1.60, tilt=-56 * side), "house")
    yield Object(Cuboid((1.10, 0.30, 0.06)), OCHRE, at(0, 0, 1.48), "house")
    yield Object(Cuboid((1.10, 0.13, 0.09)), OCHRE, at(0, 0, 1.62), "house")
    yield Object(Cuboid((0.16, 0.02, 0.30)), TIMBER, at(0.10, -0.55, 0.30), "house")
    yield Object(Arch((0.21, 0.03, 0.36), 0.16, spring=0.50, rounding=0.0), STONE, at(0.10, -0.56, 0.36), "house")
    for x in (-0.70, 0.10, 0.75):
        for z in (0.48, 1.10):
            if (x, z) != (0.10, 0.48):
                yield Object(Cuboid((0.14, 0.015, 0.17)), SHUTTER, at(x, -0.56, z), "house")
                yield Object(Cuboid((0.18, 0.035, 0.016)), STONE, at(x, -0.56, z - 0.19), "house")
    yield Object(Cuboid((0.09, 0.09, 0.20)), SANDSTONE, at(-0.6, 0.15, 1.75), "house")


def pergola(x: float):
    for y in (-1.2, -0.4, 0.4, 1.2):
        for shift in (0.0, 0.8):
            yield Object(Cylinder(0.055, 0.42), STONE, Pose.at(x + shift, y, FLOOR + 0.50), "pergola")
            yield Object(Cuboid((0.085, 0.085, 0.04), 0.01), STONE, Pose.at(x + shift, y, FLOOR + 0.04), "pergola")
            yield Object(Cuboid((0.075, 0.075, 0.025), 0.008), STONE, Pose.at(x + shift, y, FLOOR + 0.94), "pergola")
    for shift in (0.0, 0.8):
        yield Object(Cuboid((1.45, 0.035, 0.04)), TIMBER, Pose.at(x + shift, 0, FLOOR + 1.0, turn=90), "pergola")
    for i in range(9):
        yield Object(Cuboid((0.58, 0.022, 0.03)), TIMBER, Pose.at(x + 0.4, 0.32 * (i - 4), FLOOR + 1.07), "pergola")


def low_wall(y: float):
    for x in (-1.42, 1.42):
        yield Object(Cuboid((0.78, 0.08, 0.13)), SANDSTONE, Pose.at(x, y, FLOOR + 0.13), "wall")
        yield Object(Cuboid((0.81, 0.11, 0.02), 0.006), STONE, Pose.at(x, y, FLOOR + 0.28), "wall")
    for x in (-0.60, 0.60):
        yield Object(Cuboid((0.11, 0.11, 0.22)), SANDSTONE, Pose.at(x, y, FLOOR + 0.22), "wall")
        yield Object(Ball(0.10), STONE, Pose.at(x, y, FLOOR + 0.53), "wall")


def pots():
    for x, y, size in (
        (-0.95, 1.25, 1.0),
        (0.95, 1.25, 1.0),
        (-1.35, -1.30, 1.2),
        (1.30, -1.35, 0.9),
        (-1.45, 0.95, 0.8),
    ):
        pot, bush = 0.13 * size, 0.19 * size
        yield Object(Cone(0.7 * pot, pot, pot), TERRACOTTA, Pose.at(x, y, FLOOR + pot), "pots")
        yield Object(Torus(pot, 0.018), TERRACOTTA, Pose.at(x, y, FLOOR + 2 * pot), "pots")
        yield Object(Ball(bush), LEAVES, Pose.at(x, y, FLOOR + 2 * pot + 0.75 * bush, turn=70 * x), "pots")


def trees():
    for x, y, height in (
        (-1.3, -3.2, 1.9),
        (-2.3, -3.9, 2.3),
        (1.7, -3.6, 2.1),
        (3.4, -5.5, 2.4),
        (-4.5, -7.0, 2.6),
        (0.9, -9, 2.6),
    ):
        yield Object(
            Cone(0.13 * height, 0.0, 0.5 * height, 0.05), CYPRESS, Pose.at(x, y, FLOOR + 0.52 * height), "trees"
        )
    for x, y in ((0.4, -6.0), (6.5, -3.5), (5.5, 2.5), (-7.5, -3.0), (3.5, 7.0), (-3.0, 7.5), (-9.0, 5.0), (8.0, 7.5)):
        turn = 40 * x
        yield Object(Cylinder(0.10, 0.35), TIMBER, Pose.at(x, y, FLOOR + 0.35), "trees")
        for dx, dy, z, r in (
            (0, 0, 1.05, 0.50),
            (0.38, 0.1, 0.85, 0.36),
            (-0.33, 0.2, 0.90, 0.38),
            (0.05, -0.35, 0.88, 0.36),
        ):
            yield Object(Ball(r), LEAVES, Pose.at(x + dx, y + dy, FLOOR + z, turn=turn), "trees")


def hills():
    places = (
        (-6, -28, 20, 2.6, (0.55, 0.58, 0.32)),
        (14, -26, 24, 3.4, (0.48, 0.54, 0.32)),
        (-24, -18, 22, 4.2, (0.44, 0.51, 0.34)),
        (27, -8, 20, 3.6, (0.50, 0.54, 0.30)),
        (-28, 8, 24, 4.6, (0.42, 0.50, 0.34)),
        (24, 18, 24, 4.4, (0.46, 0.52, 0.33)),
        (-8, 28, 26, 5.0, (0.43, 0.50, 0.35)),
        (8, 30, 20, 3.4, (0.50, 0.55, 0.33)),
    )
    for i, (x, y, radius, height, colour) in enumerate(places):
        shade = (0.55 * colour[0], 0.55 * colour[1], 0.55 * colour[2])
        woods = Mottle(colour, shade, size=3.0, contrast=1.2, seed=float(i))
        yield Object(Ball(radius), Material(woods), Pose.at(x, y, FLOOR + height - radius), "hills")
    tower = Pose.at(13.2, -24.8, FLOOR + 3.2)
    yield Object(Cylinder(0.55, 1.2), SANDSTONE, tower @ Pose.at(0, 0, 0.9), "hills")
    yield Object(Cone(0.75, 0.0, 0.5), TILES, tower @ Pose.at(0, 0, 2.6), "hills")


def world() -> World:
    """Everything within 64 units, on an infinite plane."""
    objects = (
        Object(Plane(), GRASS, Pose.at(0, 0, FLOOR - 0.03), "ground"),
        Object(Cuboid((2.6, 2.6, 0.1)), PAVING, Pose.at(0, 0, FLOOR - 0.1), "terrace"),
        *fountain(),
        *arcade(2.0),
        *house(Pose.at(-2.35, 0.1, FLOOR, turn=90)),
        *pergola(1.55),
        *low_wall(-2.1),
        *pots(),
        *trees(),
        *hills(),
    )
    sun = Sun((0.55, -0.75, 0.62), radius=0.012, power=0.92, colour=(1.0, 0.92, 0.78))
    sky = Sky(
        (0.34, 0.56, 0.86),
        (0.83, 0.89, 0.94),
        (0.62, 0.55, 0.44),
        light=0.75,
        visible=True,
        clouds=0.55,
        haze=0.018,
        reach=0.4,
    )
    return World(objects, (sun,), sky)


def stage(size: int = 200, views: int = 100, seed: int = 0) -> SyntheticStage:
    """The courtyard, with training views around its fountain; held-out views are one walk around it."""
    random = np.random.default_rng(seed)
    cameras = {
        "train": pinhole(walk(views, 0.75, 1.15, random), size, 75.0),
        "test": pinhole(stroll(max(views * 2 // 5, 1), 0.95, random), size, 75.0),
    }
    return SyntheticStage(world(), cameras, ((-1.0,) * 3, (1.0,) * 3), reach=32.0, near=0.1)
