"""Toys on a turntable: an object scene with wood, marble, paint and brass, fine rods and soft shadows."""

import numpy as np

from ..cameras import dome, pinhole, spiral
from ..shapes import Arch, Ball, Cone, Cuboid, Cylinder, Torus
from ..stage import SyntheticStage
from ..textures import Checker, Marble, Plain, Rings, Sectors, Stripes, Wood
from ..world import Lamp, Material, Object, Pose, Sky, World

TERRACOTTA = (0.80, 0.29, 0.19)
MUSTARD = (0.93, 0.68, 0.22)
SAGE = (0.47, 0.63, 0.42)
TEAL = (0.10, 0.45, 0.50)
NAVY = (0.13, 0.22, 0.43)
CREAM = (0.95, 0.90, 0.80)
CHARCOAL = (0.13, 0.13, 0.15)

MAPLE = Material(Wood((0.86, 0.70, 0.50), (0.70, 0.50, 0.31), ring=0.05, seed=1.0), gloss=0.5, roughness=0.5)
WALNUT = Material(Wood((0.47, 0.30, 0.19), (0.26, 0.15, 0.09), ring=0.07, seed=2.0), gloss=0.8, roughness=0.35)
BRASS = Material(Plain((0.90, 0.72, 0.40)), roughness=0.35, metal=1.0)


def paint(colour) -> Material:
    return Material(Plain(colour), gloss=1.0, roughness=0.32)


def turntable():
    marble = Material(Marble((0.87, 0.84, 0.80), (0.42, 0.40, 0.41), vein=0.5, seed=3.0), gloss=0.7, roughness=0.3)
    yield Object(Cylinder(0.98, 0.055, rounding=0.02), WALNUT, Pose.at(0, 0, -0.067, turn=30), "turntable")
    yield Object(Cylinder(0.88, 0.02), marble, Pose.at(0, 0, -0.02), "turntable")
    yield Object(Torus(0.885, 0.012), BRASS, Pose.at(0, 0, -0.01), "turntable")


def stacking_rings(place: Pose):
    yield Object(Cylinder(0.25, 0.03, rounding=0.015), MAPLE, place @ Pose.at(0, 0, 0.03), "rings")
    yield Object(Cylinder(0.03, 0.36), MAPLE, place @ Pose.at(0, 0, 0.42), "rings")
    z = 0.06
    for i, colour in enumerate((NAVY, TEAL, SAGE, MUSTARD, TERRACOTTA)):
        tube = 0.078 - 0.006 * i
        shift = 0.006 * np.cos(2.4 * i), 0.006 * np.sin(2.4 * i)
        yield Object(Torus(0.20 - 0.025 * i, tube), paint(colour), place @ Pose.at(*shift, z + tube), "rings")
        z += 1.96 * tube
    yield Object(Ball(0.08), paint(CREAM), place @ Pose.at(0, 0, z + 0.065), "rings")


def castle(place: Pose):
    yield Object(
        Arch((0.27, 0.10, 0.17), 0.13, spring=0.09, rounding=0.008), MAPLE, place @ Pose.at(0, 0, 0.17), "castle"
    )
    yield Object(Cylinder(0.09, 0.10, rounding=0.006), paint(TEAL), place @ Pose.at(0, 0, 0.44), "castle")
    yield Object(Cone(0.13, 0.0, 0.11, rounding=0.008), paint(TERRACOTTA), place @ Pose.at(0, 0, 0.65), "castle")


def cubes(place: Pose):
    checks = Material(Checker(CREAM, CHARCOAL, size=0.085, shift=0.0425), gloss=0.6, roughness=0.4)
    stripes = Material(Stripes(MUSTARD, CREAM, period=0.05), gloss=0.6, roughness=0.4)
    yield Object(Cuboid((0.17,) * 3, rounding=0.018), checks, place @ Pose.at(0, 0, 0.17), "checks")
    yield Object(Cuboid((0.095,) * 3, rounding=0.014), stripes, place @ Pose.at(-0.02, 0.01, 0.435, turn=38), "stripes")


def ball(place: Pose):
    leather = Material(Sectors(TERRACOTTA, CREAM, count=5, cap=0.165), gloss=1.0, roughness=0.25)
    yield Object(Ball(0.175), leather, place @ Pose.at(0, 0, 0.175, turn=20, tilt=38), "ball")


def spinning_top(place: Pose):
    rings = Material(Rings(NAVY, MUSTARD, period=0.06, share=0.4), gloss=1.0, roughness=0.3)
    place = place @ Pose.at(0, 0, 0.005, tilt=24)
    yield Object(Cone(0.012, 0.12, 0.06, rounding=0.006), rings, place @ Pose.at(0, 0, 0.06), "top")
    yield Object(Cylinder(0.124, 0.022, rounding=0.012), rings, place @ Pose.at(0, 0, 0.138), "top")
    yield Object(Cylinder(0.015, 0.06, rounding=0.006), MAPLE, place @ Pose.at(0, 0, 0.21), "top")


def abacus(place: Pose):
    for side in (-1, 1):
        yield Object(Cuboid((0.02, 0.03, 0.19), 0.006), WALNUT, place @ Pose.at(0.26 * side, 0, 0.22), "abacus")
    yield Object(Cuboid((0.31, 0.075, 0.018), 0.008), WALNUT, place @ Pose.at(0, 0, 0.018), "abacus")
    yield Object(Cuboid((0.29, 0.035, 0.018), 0.008), WALNUT, place @ Pose.at(0, 0, 0.42), "abacus")
    lying = Pose.about((0, 1, 0), 90)
    rows = (
        (TERRACOTTA, (-0.20, -0.13, -0.06, 0.13, 0.20)),
        (MUSTARD, (-0.20, -0.13, 0.06, 0.13, 0.20)),
        (TEAL, (-0.20, 0.0, 0.07, 0.14, 0.21)),
    )
    for row, (colour, beads) in enumerate(rows):
        rod = place @ Pose.at(0, 0, 0.12 + 0.105 * row)
        yield Object(Cylinder(0.007, 0.25), BRASS, rod @ lying, "abacus")
        for x in beads:
            yield Object(Torus(0.022, 0.026), paint(colour), rod @ Pose.at(x, 0, 0) @ lying, "abacus")


def marbles():
    places = ((-0.10, -0.24, 0.062, TEAL), (-0.28, -0.44, 0.05, TERRACOTTA), (0.60, -0.42, 0.064, NAVY))
    for i, (x, y, radius, colour) in enumerate(places):
        glass = Material(Marble(colour, CREAM, vein=0.11, turbulence=1.2, seed=4.0 + i), gloss=1.0, roughness=0.2)
        yield Object(Ball(radius), glass, Pose.at(x, y, radius), "marbles")


def world() -> World:
    """The toys, centred, within [-1, 1]^3; the turntable nearly fills it."""
    objects = (
        *turntable(),
        *stacking_rings(Pose.at(-0.33, 0.34, 0)),
        *castle(Pose.at(0.46, 0.16, 0, turn=-32)),
        *cubes(Pose.at(0.22, -0.40, 0, turn=24)),
        *ball(Pose.at(-0.56, -0.22, 0)),
        *spinning_top(Pose.at(-0.14, -0.66, 0, turn=50)),
        *abacus(Pose.at(0.20, 0.66, 0, turn=-14)),
        *marbles(),
    )
    key = Lamp((-2.8, -1.5, 3.2), radius=0.42, power=18.0, colour=(1.0, 0.95, 0.87))
    fill = Lamp((3.0, 0.6, 2.2), radius=0.8, power=3.6, colour=(0.86, 0.93, 1.0))
    sky = Sky((0.84, 0.91, 1.0), (0.95, 0.94, 0.92), (0.70, 0.62, 0.54), light=0.38)
    upright = World(objects, (key, fill), sky)
    low, high = upright.bounds()
    return upright.transformed(Pose((0.0, 0.0, -0.5 * float(low[2] + high[2]))))


def stage(size: int = 200, views: int = 100, seed: int = 0) -> SyntheticStage:
    """The toys seen from a dome; held-out views climb around them."""
    random = np.random.default_rng(seed)
    cameras = {
        "train": pinhole(dome(views, 3.6, random), size, 36.0),
        "test": pinhole(spiral(max(views * 2 // 5, 1), 3.6, random), size, 36.0),
    }
    return SyntheticStage(world(), cameras, ((-1.0, -1.0, -0.5), (1.0, 1.0, 0.5)), reach=1.0, near=1.5)
