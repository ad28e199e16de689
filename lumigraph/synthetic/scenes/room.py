"""A study at home: a closed room, seen from inside in all directions. A unit is some 2.6 metres; eyes are at z = 0.

procedural:room,depth,views=300,size=320        a hand-held depth camera once around it; pictures of 320x240, metres
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from ...camera import Camera
from ..cameras import GOLDEN_ANGLE, hand_held, look_at, pinhole, sphere_point
from ..depth_camera import DepthCamera
from ..shapes import Ball, Cone, Cuboid, Cylinder, Torus
from ..stage import Flag, Pictures, SyntheticStage
from ..textures import Bricks, Checker, Marble, Mottle, Plain, Rings, Sectors, Stripes, Wood
from ..world import Lamp, Material, Object, Pose, Sky, World

HALF_X, HALF_Y, FLOOR, CEILING = 0.95, 0.75, -0.50, 0.42
WALL = 0.02  # half of its thickness
METRES_PER_UNIT = 2.6
DEPTH_FIELD_OF_VIEW = 62.7  # degrees across, of the depth camera: 525 pixels at 640
WALK, NARROW_WALK = (0.30, 0.22), (0.22, 0.14)  # half-axes of the path around the middle: its own, of held-out views

CREAM, RUST, PETROL, OCHRE, INK = (
    (0.93, 0.88, 0.78), (0.70, 0.30, 0.20), (0.13, 0.36, 0.41), (0.86, 0.62, 0.25), (0.14, 0.16, 0.22),
)  # fmt: skip
OAK = Material(Wood((0.72, 0.53, 0.35), (0.52, 0.35, 0.21), ring=0.05, seed=1.0), gloss=0.2, roughness=0.5)
WALNUT = Material(Wood((0.45, 0.29, 0.18), (0.25, 0.15, 0.09), ring=0.06, seed=2.0), gloss=0.3, roughness=0.5)
PLASTER = Material(Mottle((0.90, 0.86, 0.78), (0.78, 0.73, 0.65), size=0.16, contrast=0.9, seed=1.0))
PAPER = Material(Stripes((0.45, 0.58, 0.55), (0.80, 0.80, 0.70), period=0.10, share=0.35))
BRICK = Material(Bricks((0.72, 0.44, 0.33), (0.62, 0.56, 0.50), length=0.11, height=0.04, joint=0.006, variation=0.2))
LEAVES = Material(Mottle((0.38, 0.53, 0.25), (0.15, 0.28, 0.13), size=0.07, contrast=1.3))


def shell():
    """Floor, ceiling and four walls, of different materials, so that every view is distinct."""
    up, middle = (CEILING - FLOOR) / 2, (CEILING + FLOOR) / 2
    boards = Material(Stripes((0.60, 0.43, 0.27), (0.45, 0.30, 0.18), period=0.11, share=0.5))
    on_side = Pose.about((1, 0, 0), 90)
    yield Object(Cuboid((HALF_X, WALL, HALF_Y)), boards, Pose.at(0, 0, FLOOR - WALL) @ on_side, "floor")
    yield Object(Cuboid((HALF_X, HALF_Y, WALL)), PLASTER, Pose.at(0, 0, CEILING + WALL), "ceiling")
    for i in range(6):
        beam = Cuboid((HALF_X, 0.03, 0.025), 0.006)
        yield Object(beam, WALNUT, Pose.at(0, 0.26 * (i - 2.5), CEILING - 0.02), "ceiling")
    lying = Pose.about((0, 1, 0), 90)  # stripes upright
    for side, material in ((-1, BRICK), (1, PLASTER)):
        yield Object(Cuboid((WALL, HALF_Y, up)), material, Pose.at(side * (HALF_X + WALL), 0, middle), "walls")
    for side, material in ((-1, PAPER), (1, PAPER)):
        wall = Pose.at(0, side * (HALF_Y + WALL), middle) @ lying
        yield Object(Cuboid((up, WALL, HALF_X)), material, wall, "walls")
    for side in (-1, 1):
        for half, x, y in (((0.008, HALF_Y, 0.03), HALF_X, 0.0), ((HALF_X, 0.008, 0.03), 0.0, HALF_Y)):
            yield Object(Cuboid(half), OAK, Pose.at(side * x, side * y, FLOOR + 0.03), "walls")


def shelf(place: Pose):
    """Books in four rows."""
    random = np.random.default_rng(4)
    colours = (CREAM, RUST, PETROL, OCHRE, INK, (0.42, 0.50, 0.36))
    for side in (-1, 1):
        yield Object(Cuboid((0.012, 0.08, 0.36)), WALNUT, place @ Pose.at(0.32 * side, 0, 0.36), "shelf")
    for row in range(5):
        yield Object(Cuboid((0.32, 0.08, 0.01)), WALNUT, place @ Pose.at(0, 0, 0.01 + 0.175 * row), "shelf")
        x = -0.29
        while row < 4 and x < 0.27:
            thick, high = random.uniform(0.010, 0.026), random.uniform(0.045, 0.070)
            cover = Material(Stripes(colours[random.integers(6)], colours[random.integers(6)], 0.05, share=0.15))
            book = Cuboid((thick, 0.055, high), 0.003)
            yield Object(book, cover, place @ Pose.at(x + thick, 0.01, 0.02 + 0.175 * row + high), "shelf")
            x += 2 * thick + 0.004


def table(place: Pose):
    yield Object(Cylinder(0.22, 0.012, rounding=0.005), OAK, place @ Pose.at(0, 0, 0.28), "table")
    yield Object(Cylinder(0.022, 0.13), OAK, place @ Pose.at(0, 0, 0.14), "table")
    yield Object(Cylinder(0.13, 0.012, rounding=0.005), OAK, place @ Pose.at(0, 0, 0.012), "table")
    globe = Material(Marble((0.25, 0.45, 0.60), (0.80, 0.74, 0.52), vein=0.12, turbulence=1.5), gloss=0.5)
    yield Object(Ball(0.075), globe, place @ Pose.at(0.04, 0.05, 0.385, tilt=23), "table")
    yield Object(Cylinder(0.04, 0.008), WALNUT, place @ Pose.at(0.04, 0.05, 0.30), "table")
    checks = Material(Checker(CREAM, INK, size=0.026, shift=0.013))
    yield Object(Cuboid((0.10, 0.10, 0.008)), checks, place @ Pose.at(-0.07, -0.08, 0.30, turn=25), "table")


def sofa(place: Pose):
    cloth = Material(Mottle(PETROL, (0.09, 0.27, 0.31), size=0.05, contrast=0.8))
    yield Object(Cuboid((0.36, 0.15, 0.07), 0.02), cloth, place @ Pose.at(0, 0, 0.10), "sofa")
    yield Object(Cuboid((0.36, 0.05, 0.11), 0.02), cloth, place @ Pose.at(0, 0.12, 0.25, tilt=-10), "sofa")
    for side in (-1, 1):
        yield Object(Cuboid((0.045, 0.15, 0.12), 0.02), cloth, place @ Pose.at(0.38 * side, 0, 0.14), "sofa")
        cushion = Material(Stripes(OCHRE if side < 0 else RUST, CREAM, period=0.03, share=0.3))
        yield Object(
            Cuboid((0.075, 0.03, 0.075), 0.02), cushion, place @ Pose.at(0.22 * side, 0.03, 0.24, 12, -25), "sofa"
        )


def pictures():
    """Frames on two walls, a window with light curtains on the third, a door in the fourth."""
    motifs = (Sectors(RUST, CREAM, count=8), Rings(PETROL, OCHRE, period=0.04), Mottle(OCHRE, INK, size=0.06))
    for i, motif in enumerate(motifs):
        place = Pose.at(-0.52 + 0.5 * i, HALF_Y - 0.01, 0.12 - 0.03 * (i % 2))
        yield Object(Cuboid((0.13, 0.012, 0.16)), WALNUT, place, "pictures")
        yield Object(Cuboid((0.11, 0.018, 0.14)), Material(motif), place, "pictures")
    window = Material(Checker((0.96, 0.98, 1.0), (0.70, 0.82, 0.94), size=0.16, shift=0.08))
    yield Object(Cuboid((0.012, 0.26, 0.22)), OAK, Pose.at(HALF_X - 0.012, 0.08, 0.08), "window")
    yield Object(Cuboid((0.016, 0.24, 0.20)), window, Pose.at(HALF_X - 0.012, 0.08, 0.08), "window")
    for side in (-1, 1):
        curtain = Material(Stripes(CREAM, RUST, period=0.05, share=0.25))
        hanging = Pose.at(HALF_X - 0.03, 0.08 + 0.31 * side, 0.02) @ Pose.about((1, 0, 0), 90)
        yield Object(Cuboid((0.015, 0.32, 0.06), 0.01), curtain, hanging, "window")
    yield Object(Cuboid((0.15, 0.012, 0.37)), OAK, Pose.at(0.55, -HALF_Y, FLOOR + 0.37), "door")
    yield Object(Ball(0.016), Material(Plain(OCHRE), metal=1.0), Pose.at(0.44, -HALF_Y + 0.03, FLOOR + 0.36), "door")


def plants():
    clay = Material(Mottle((0.76, 0.44, 0.30), (0.62, 0.33, 0.22), size=0.06))
    for x, y, size in ((0.76, 0.58, 1.0), (-0.80, -0.60, 1.2)):
        yield Object(Cone(0.05 * size, 0.075 * size, 0.07), clay, Pose.at(x, y, FLOOR + 0.07), "plants")
        for turn, lift in ((0, 0.22), (120, 0.29), (240, 0.25)):
            leaf = Pose.at(x, y, FLOOR + lift * size, turn=turn, tilt=30) @ Pose.at(0, -0.05 * size, 0)
            yield Object(Ball(0.07 * size), LEAVES, leaf, "plants")


def world() -> World:
    """Everything within [-1, 1]^3, with free space in the middle."""
    rug = Material(Rings((0.62, 0.24, 0.18), (0.90, 0.80, 0.62), period=0.09, share=0.4))
    objects = (
        *shell(),
        *shelf(Pose.at(-0.42, -0.66, FLOOR)),
        *table(Pose.at(0.58, -0.30, FLOOR)),
        *sofa(Pose.at(-0.10, 0.55, FLOOR)),
        *pictures(),
        *plants(),
        Object(Cylinder(0.36, 0.006, rounding=0.003), rug, Pose.at(0, -0.04, FLOOR + 0.006), "rug"),
        Object(Cone(0.14, 0.07, 0.06), Material(Plain(OCHRE)), Pose.at(-0.70, 0.30, 0.10), "lamp"),
        Object(Cylinder(0.010, 0.28), WALNUT, Pose.at(-0.70, 0.30, -0.20), "lamp"),
        Object(Torus(0.07, 0.012), WALNUT, Pose.at(-0.70, 0.30, FLOOR + 0.012), "lamp"),
    )
    lights = (
        Lamp((0.15, 0.05, 0.06), radius=0.03, power=0.06, colour=(1.0, 0.94, 0.84)),
        Lamp((-0.70, 0.30, 0.24), radius=0.03, power=0.012, colour=(1.0, 0.82, 0.60)),
        Lamp((0.50, 0.08, 0.08), radius=0.03, power=0.03, colour=(0.88, 0.94, 1.0)),
    )
    sky = Sky((0.95, 0.93, 0.90), (0.92, 0.90, 0.87), (0.80, 0.72, 0.62), light=0.62, visible=True, reach=0.15)
    return World(objects, lights, sky)


def inside(count: int, random: np.random.Generator, reach: float = 0.28):
    """Poses near the middle of the room, evenly spread over viewing directions except steep ones."""
    poses = []
    for k in range(count):
        height = 0.97 * (1 - (2 * k + 1) / count)
        gaze = sphere_point(GOLDEN_ANGLE * k, math.asin(height))
        eye = sphere_point(random.uniform(0, 2 * math.pi), 0.0, reach * math.sqrt(random.uniform()))
        eye = eye + (0, 0, random.uniform(-0.20, 0.16))
        poses.append(look_at(eye, eye + gaze))
    order = random.permutation(count)  # any first few views should see all around, too
    return np.stack(poses)[order]


@dataclass(frozen=True)
class Options(Pictures):
    """Options of every scene, and:

    depth: a depth camera on a hand-held path instead of photographs all around; pictures three quarters as high as wide
    """

    depth: Flag = 0


def stage(size: int = 200, views: int = 100, seed: int = 0, depth: int = 0) -> SyntheticStage:
    """The room from near its middle, in all directions; held-out views likewise. depth: see `Options`"""
    random = np.random.default_rng(seed)
    bounds = (-1.0, -0.8, -0.56), (1.0, 0.8, 0.5)
    if depth:
        path, beside = hand_held(views, WALK, random), hand_held(max(views // 10, 1), NARROW_WALK, random)
        shape = (size, size * 3 // 4)
        cameras = {
            "train": counted(pinhole(path, shape, DEPTH_FIELD_OF_VIEW), 0),
            "test": counted(pinhole(beside, shape, DEPTH_FIELD_OF_VIEW), views),
        }
        sensor = DepthCamera(METRES_PER_UNIT, seed=seed)
        return SyntheticStage(world(), cameras, bounds, reach=1.0, near=0.1, depth_camera=sensor, unit=METRES_PER_UNIT)
    cameras = {
        "train": pinhole(inside(views, random), size, 80.0),
        "test": pinhole(inside(max(views * 2 // 5, 1), random, 0.22), size, 80.0),
    }
    return SyntheticStage(world(), cameras, bounds, reach=1.0, near=0.1)


def counted(cameras: Camera, first: int) -> Camera:
    """Cameras with image indices from `first` on."""
    return replace(cameras, image_index=torch.arange(first, first + len(cameras)))
