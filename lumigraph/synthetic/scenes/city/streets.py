"""Streets: asphalt and its markings, pavements, houses around, trees, lamps and parked cars. Lengths in metres."""

import math
from collections.abc import Iterator

import numpy as np

from ...categories import cars
from ...shapes import Ball, Cuboid, Cylinder, Plane
from ...textures import Bricks, Mottle, Plain, Stripes, Wood
from ...world import Material, Object, Pose, World
from .houses import house
from .plan import OUTSKIRTS, PAVEMENT, PITCH, ROAD, Crossing, neighbours

KERB = 0.12  # height of the pavement
CAR = 3.0  # metres to a unit of the category of cars
PARKED = 4.0  # from the middle of the street to the middle of parked cars
CORNER = 9.5  # from a crossing to the first of them
SLOT, TAKEN = 5.6, 0.65  # length of a place to park, and how often somebody does

ASPHALT = Material(Mottle((0.40, 0.40, 0.42), (0.28, 0.28, 0.30), size=2.5, contrast=1.3))
GRASS = Material(Mottle((0.50, 0.55, 0.32), (0.33, 0.42, 0.22), size=6.0, contrast=1.2))
FLAGS = Material(Bricks((0.68, 0.66, 0.62), (0.46, 0.44, 0.42), length=0.8, height=0.8, joint=0.04, variation=0.15))
DASHES = Material(Stripes((0.34, 0.34, 0.36), (0.90, 0.90, 0.88), period=4.0, share=0.5))
ZEBRA = Material(Stripes((0.34, 0.34, 0.36), (0.90, 0.90, 0.88), period=1.0, share=0.5, shift=0.5))
BARK = Material(Wood((0.46, 0.36, 0.27), (0.30, 0.22, 0.16), ring=0.2))
IRON = Material(Plain((0.16, 0.19, 0.19)), gloss=0.5, roughness=0.4)
GLOBE = Material(Plain((0.95, 0.93, 0.86)), gloss=0.6, roughness=0.4)
LEAVES = tuple(
    Material(Mottle(light, dark, size=0.9, contrast=1.4, seed=seed))
    for light, dark, seed in (
        ((0.42, 0.55, 0.24), (0.16, 0.27, 0.11), 0.0),
        ((0.55, 0.58, 0.22), (0.25, 0.31, 0.10), 3.0),
        ((0.30, 0.47, 0.26), (0.11, 0.22, 0.12), 7.0),
    )
)


def standing(places: list[Crossing], seed: int) -> World:
    """All static objects, without light. places: the crossings"""
    random = np.random.default_rng([seed, 0xC17])
    columns, rows = (max(place[axis] for place in places) + 1 for axis in range(2))
    objects = [*ground(columns, rows), *markings(places)]
    for i in range(-1, columns):
        for j in range(-1, rows):
            objects += quarter(i, j, columns, rows, random)
    objects += [thing for here, there in streets(places) for thing in lined(here, there, random)]
    return World(tuple(objects))


def streets(places: list[Crossing]) -> list[tuple[Crossing, Crossing]]:
    """Each street once, eastwards or northwards."""
    return [(here, there) for here, others in neighbours(places).items() for there in others if there > here]


def ground(columns: int, rows: int) -> Iterator[Object]:
    middle = 0.5 * PITCH * (columns - 1), 0.5 * PITCH * (rows - 1)
    yield Object(Plane(), GRASS, Pose.at(0, 0, -0.3), "ground")
    half = middle[0] + OUTSKIRTS, middle[1] + OUTSKIRTS, 0.2
    yield Object(Cuboid(half), ASPHALT, Pose.at(*middle, -0.2), "ground")


def between(here: Crossing, there: Crossing) -> tuple[Pose, float]:
    """Pose of a street's centre, x along it; and half its length between the crossings."""
    (a, b), (c, d) = here, there
    turn = math.degrees(math.atan2(d - b, c - a))
    return Pose.at(0.5 * PITCH * (a + c), 0.5 * PITCH * (b + d), 0, turn=turn), 0.5 * PITCH - ROAD


def markings(places: list[Crossing]) -> Iterator[Object]:
    """Road markings: dashes along the middle, and pedestrian crossings."""
    upright = Pose.about((0, 1, 0), 90)  # stripes go across z: turned along the street
    aside = Pose.about((1, 0, 0), 90)
    for here, there in streets(places):
        middle, half = between(here, there)
        yield Object(Cuboid((0.01, 0.08, half - 4)), DASHES, middle @ upright, "ground")
        for end in (-1, 1):
            zebra = middle @ Pose.at(end * (half - 1.6), 0, 0) @ aside
            yield Object(Cuboid((1.2, 0.011, ROAD - 0.4)), ZEBRA, zebra, "ground")


def quarter(i: int, j: int, columns: int, rows: int, random: np.random.Generator) -> Iterator[Object]:
    """Houses between four crossings, of which (i, j) is the lowest, in two rows back to back, on their pavement."""
    half = 0.5 * PITCH - ROAD
    middle = Pose.at((i + 0.5) * PITCH, (j + 0.5) * PITCH, 0)
    yield Object(Cuboid((half, half, KERB), 0.02), FLAGS, middle, "pavement")
    built = half - PAVEMENT
    for north in (False, True):
        count = int(random.integers(2, 4))
        shares = random.dirichlet(np.full(count, 20.0))
        edges = built * (2 * np.concatenate([[0.0], shares.cumsum()]) - 1)
        for k in range(count):
            west, east = float(edges[k]), float(edges[k + 1])
            seen = (
                (north and j < rows - 1, 180.0),
                (not north and j >= 0, 0.0),
                (k == 0 and i >= 0, 270.0),
                (k == count - 1 and i < columns - 1, 90.0),
            )
            fronts = tuple(turn for there, turn in seen if there)
            place = middle @ Pose.at(0.5 * (west + east), (0.5 if north else -0.5) * built, KERB)
            yield from house(place, (0.5 * (east - west), 0.5 * built), fronts, random)


def lined(here: Crossing, there: Crossing, random: np.random.Generator) -> Iterator[Object]:
    """Objects along a street, on both sides: trees and lamps on the pavement, cars by the kerb."""
    middle, half = between(here, there)
    reach = half + ROAD - CORNER
    for side in (-1, 1):
        edge = side * (ROAD + 0.7)
        for x in np.linspace(-reach, reach, 4).tolist():
            if random.uniform() < 0.45:
                yield from tree(middle @ Pose.at(x + random.uniform(-1, 1), edge, KERB), random)
        yield from lamp(middle @ Pose.at(side * (half - 1.0), edge, KERB, turn=90 * (1 - side)))
        slots = int(2 * reach / SLOT)
        for k in range(slots):
            if random.uniform() < TAKEN:
                x = (k + 0.5 - slots / 2) * SLOT + random.uniform(-0.3, 0.3)
                yield from car(middle @ Pose.at(x, side * PARKED, 0, turn=90 * (1 + side)), random, "cars")


def tree(place: Pose, random: np.random.Generator) -> Iterator[Object]:
    leaves, height = LEAVES[random.integers(len(LEAVES))], random.uniform(2.3, 3.0)
    yield Object(Cylinder(0.13, 0.5 * height), BARK, place @ Pose.at(0, 0, 0.5 * height), "trees")
    yield Object(Ball(1.05), leaves, place @ Pose.at(0, 0, height + 0.7), "trees")
    for turn in (0, 120, 240):
        ball = Pose.at(0, 0, 0, turn=turn + random.uniform(-30, 30)) @ Pose.at(0.65, 0, height + random.uniform(0, 0.9))
        yield Object(Ball(random.uniform(0.6, 0.8)), leaves, place @ ball, "trees")


def lamp(place: Pose) -> Iterator[Object]:
    yield Object(Cylinder(0.07, 2.3), IRON, place @ Pose.at(0, 0, 2.3), "lamps")
    yield Object(Cylinder(0.14, 0.25), IRON, place @ Pose.at(0, 0, 0.25), "lamps")
    yield Object(Ball(0.24), GLOBE, place @ Pose.at(0, 0, 4.8), "lamps")


def car(place: Pose, random: np.random.Generator, name: str) -> Iterator[Object]:
    """A random car, its wheels on the ground, facing +x of its place."""
    parts = [part.scaled(CAR) for part in cars.objects(random, astray=0.0)]
    lowest = min(float(part.bounds()[0][2]) for part in parts)
    turned = place @ Pose.at(0, 0, -lowest, turn=180)
    for part in parts:
        yield Object(part.shape, part.material, turned @ part.pose, name)
