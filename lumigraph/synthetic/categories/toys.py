"""Stacking figures: a foot, rings or drums on a rod, arms, a head that looks one way, and a hat."""

from collections.abc import Iterator

import numpy as np

from ..shapes import Ball, Cone, Cuboid, Cylinder, SolidShape, Torus
from ..world import Material, Object, Pose
from .parts import RUBBER, colour, finish, paint, timber

BOUNDS = ((-0.8, -0.8, -0.85), (0.8, 0.8, 0.85))
LYING = Pose.about((0, 1, 0), 90)  # turns an upright shape along x


def objects(random: np.random.Generator) -> Iterator[Object]:
    """One figure, centred. It faces about -y."""
    pieces = list(figure(random))
    low, high = min(o.bounds()[0][2] for o in pieces), max(o.bounds()[1][2] for o in pieces)
    place = Pose.at(0, 0, 0, turn=random.uniform(-25, 25)) @ Pose.at(0, 0, -0.5 * (low + high))
    yield from (Object(o.shape, o.material, place @ o.pose, o.name) for o in pieces)


def figure(random: np.random.Generator) -> Iterator[Object]:
    def part(shape: SolidShape, material: Material, x: float, y: float, z: float, turn: Pose | None = None) -> Object:
        place = Pose.at(x, y, z)
        return Object(shape, material, place @ turn if turn else place, "figure")

    foot, thick = random.uniform(0.34, 0.52), random.uniform(0.04, 0.08)
    square = random.uniform() < 0.4
    base = Cuboid((foot * 0.9, foot * 0.9, thick), 0.02) if square else Cylinder(foot, thick, rounding=0.02)
    yield part(base, finish(random), 0, 0, thick)
    z, count = 2 * thick, int(random.integers(2, 5))
    width, slim = random.uniform(0.24, 0.38), random.uniform(0.86, 1.06)
    total = random.uniform(0.5, 0.75)
    shoulder = z
    for _ in range(count):
        half = 0.5 * total / count * random.uniform(0.85, 1.15)
        kind = random.uniform()
        if kind < 0.4:
            shape: SolidShape = Cylinder(width, half, rounding=0.025)
        elif kind < 0.6:
            shape = Torus(max(width - half, 0.05), half)
        elif kind < 0.8:
            shape = Cuboid((0.86 * width, 0.86 * width, half), 0.025)
        else:
            shape = Cone(width, 0.75 * width, half, rounding=0.02)
        yield part(shape, finish(random), 0, 0, z + half)
        z, shoulder, width = z + 2 * half, z + half, width * slim
    arm, reach, skin = random.uniform(0.05, 0.08), random.uniform(0.10, 0.2), finish(random)
    for side in (-1, 1):
        yield part(Cylinder(arm * 0.7, reach), skin, side * (width + 0.6 * reach), 0, shoulder, LYING)
        yield part(Ball(arm * 1.35), skin, side * (width + 1.6 * reach), 0, shoulder)
    head, face = random.uniform(0.17, 0.25), paint(colour(random, (0.15, 0.5)))
    yield part(Ball(head), face, 0, 0, z + 0.92 * head)
    for side in (-1, 1):
        yield part(Ball(0.2 * head), RUBBER, side * 0.38 * head, -0.86 * head, z + 1.1 * head)
    yield part(Ball(0.24 * head), paint(colour(random)), 0, -1.0 * head, z + 0.85 * head)
    top, wide, tall = z + 1.6 * head, head * random.uniform(0.8, 1.2), random.uniform(0.06, 0.14)
    hat = random.uniform()
    if hat < 0.4:
        yield part(Cone(wide, 0.01, tall + 0.03, rounding=0.01), finish(random), 0, 0, top + tall)
    elif hat < 0.75:
        cloth = finish(random)
        yield part(Cylinder(1.35 * wide, 0.02, rounding=0.01), cloth, 0, 0, top - 0.02)
        yield part(Cylinder(0.8 * wide, tall, rounding=0.01), cloth, 0, 0, top + tall)
    else:
        yield part(Ball(0.35 * head), timber(random), 0, 0, top + 0.35 * head)
