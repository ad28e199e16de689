"""Traffic, from time 0 to time 1: cars of one category circle a square in two lanes, and the camera drives along.

Cars are rigid, and their boxes are known at all times. The held-out photographs are by the same camera, each between
two training photographs. `with_edits` renders the truth of an edited scene.
"""

import math
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Annotated

import numpy as np

from ...datasets.tracks import BoxTrack, TrackEdits, nodes_of
from ...files.ranges import between
from ..cameras import look_at, pinhole, sphere_point
from ..categories.cars import objects
from ..filming import BETWEEN, timed
from ..shapes import Ball, Cone, Cuboid, Cylinder
from ..stage import Pictures, SyntheticStage
from ..textures import Bricks, Checker, Mottle, Plain, Stripes
from ..world import Material, Object, Pose, Sky, Sun, World, nested

GROUND = -0.3
CAR_SCALE = 0.36  # scene units to one of the category's
LANES = (0.46, 0.84)  # radii of the lanes
TURNS = (210.0, 150.0)  # degrees that cars go round in each lane
LANE_CARS = (3, 5)  # that a lane has room for
SLOTS = ((0, 0), (1, 0), (0, 1), (1, 1), (0, 2), (1, 2), (1, 3), (1, 4))  # lane of each car, and its place in it
DISTANCE, SWEEP = 2.15, 58.0  # of the camera from the middle; degrees to either side of the front
ELEVATION, CLIMB = 24.0, 5.0  # degrees
FIELD_OF_VIEW = 46.0  # degrees
LAWN = Material(Mottle((0.36, 0.52, 0.22), (0.20, 0.34, 0.12), size=0.08))
ASPHALT = Material(Mottle((0.40, 0.40, 0.42), (0.32, 0.32, 0.34), size=0.05))
PAVING = Material(Checker((0.72, 0.68, 0.62), (0.58, 0.54, 0.49), size=0.22))
STONE = Material(Mottle((0.84, 0.80, 0.72), (0.68, 0.63, 0.55), size=0.1))
ROOF = Material(Stripes((0.50, 0.30, 0.24), (0.40, 0.24, 0.20), period=0.05))
DOOR = Material(Plain((0.22, 0.32, 0.30)), gloss=0.4)
LEAVES = Material(Mottle((0.30, 0.46, 0.18), (0.14, 0.26, 0.09), size=0.07, contrast=1.4))
# Of each house: azimuth (degrees), half of its width, its height, and its walls.
HOUSES = (
    (150.0, 0.5, 1.0, Bricks((0.66, 0.36, 0.28), (0.80, 0.77, 0.72))),
    (120.0, 0.42, 1.3, Stripes((0.86, 0.78, 0.56), (0.76, 0.67, 0.45), period=0.16)),
    (92.0, 0.5, 0.85, Bricks((0.86, 0.80, 0.68), (0.60, 0.54, 0.45), length=0.2, height=0.1)),
    (60.0, 0.48, 1.2, Bricks((0.52, 0.34, 0.30), (0.76, 0.70, 0.66))),
    (30.0, 0.45, 0.95, Stripes((0.62, 0.70, 0.74), (0.50, 0.58, 0.62), period=0.12)),
)


@dataclass(frozen=True)
class Options(Pictures):
    """Options of every scene. cars: their number"""

    cars: Annotated[int, between(1, len(SLOTS))] = 4


@cache
def car(seed: int, number: int) -> tuple[tuple[Object, ...], tuple[float, float, float]]:
    """Parts of a car in its box's frame, and the size of its tight box."""
    around = Pose.at(0, 0, 0, turn=180.0)  # the category drives towards -x
    parts = [
        replace(x, pose=around @ x.pose).scaled(CAR_SCALE)
        for x in objects(np.random.default_rng((seed, number)), astray=0.0)
    ]
    low, high = World(tuple(parts)).bounds()
    centre = Pose.at(*(-0.5 * (low + high)).tolist())
    named = tuple(replace(x, pose=centre @ x.pose, name=f"car {number + 1}") for x in parts)
    return named, tuple((high - low).tolist())


def place(seed: int, number: int, time: float) -> Pose:
    """The pose of a car's box at a time."""
    lane, slot = SLOTS[number]
    start = 360.0 * slot / LANE_CARS[lane] - 130.0 + 37.0 * lane + 11.0 * seed
    angle = start + TURNS[lane] * time
    x, y = LANES[lane] * math.cos(math.radians(angle)), LANES[lane] * math.sin(math.radians(angle))
    return Pose.at(x, y, GROUND + 0.5 * car(seed, number)[1][2], turn=angle + 90.0)


@cache
def square() -> tuple[Object, ...]:
    """All static objects."""
    parts = [
        Object(Cuboid((4.0, 4.0, 0.05)), PAVING, Pose.at(0, 0, GROUND - 0.06), "pavement"),
        Object(Cylinder(1.06, 0.02), ASPHALT, Pose.at(0, 0, GROUND - 0.02), "road"),
        Object(Cylinder(0.27, 0.03), LAWN, Pose.at(0, 0, GROUND), "island"),
        Object(Cuboid((0.07, 0.07, 0.06), 0.01), STONE, Pose.at(0, 0, GROUND + 0.09), "monument"),
        Object(Cone(0.05, 0.02, 0.16), STONE, Pose.at(0, 0, GROUND + 0.31), "monument"),
        Object(Ball(0.035), Material(Plain((0.82, 0.66, 0.28)), gloss=0.6), Pose.at(0, 0, GROUND + 0.49), "monument"),
    ]
    for azimuth, half, height, walls in HOUSES:
        angle = math.radians(azimuth)
        at = Pose.at(1.75 * math.cos(angle), 1.75 * math.sin(angle), GROUND, turn=azimuth - 90.0)
        parts.append(
            Object(Cuboid((half, 0.25, 0.5 * height)), Material(walls), at @ Pose.at(0, 0, 0.5 * height), "house")
        )
        parts.append(Object(Cuboid((half + 0.03, 0.29, 0.04)), ROOF, at @ Pose.at(0, 0, height + 0.04), "house"))
        parts.append(Object(Cuboid((0.09, 0.015, 0.17)), DOOR, at @ Pose.at(0.12, -0.25, 0.17), "house"))
    for azimuth in (75.0, 106.0, 138.0, 44.0):
        x, y = 1.3 * math.cos(math.radians(azimuth)), 1.3 * math.sin(math.radians(azimuth))
        parts.append(Object(Cylinder(0.025, 0.12), STONE, Pose.at(x, y, GROUND + 0.12), "tree"))
        parts.append(Object(Ball(0.15), LEAVES, Pose.at(x, y, GROUND + 0.34), "tree"))
    return tuple(parts)


SUN = Sun((-0.45, -0.6, 0.9), radius=0.02, power=0.85, colour=(1.0, 0.95, 0.86))
SKY = Sky((0.36, 0.58, 0.88), (0.83, 0.89, 0.94), (0.60, 0.56, 0.50), light=0.7, visible=True)


def world(seed: int, cars: int, time: float) -> World:
    """The world at a time in [0, 1]."""
    driving = [
        replace(part, pose=place(seed, number, time) @ part.pose)
        for number in range(cars)
        for part in car(seed, number)[0]
    ]
    return World((*square(), *driving), (SUN,), SKY)


def tracks(seed: int, cars: int, times: np.ndarray) -> tuple[BoxTrack, ...]:
    """The boxes of all cars at some times."""

    def track(number: int) -> BoxTrack:
        poses = [place(seed, number, float(t)) for t in times]
        turns = [math.atan2(p.rotation[1][0], p.rotation[0][0]) for p in poses]
        rotations = tuple((math.cos(0.5 * a), 0.0, 0.0, math.sin(0.5 * a)) for a in turns)
        size, positions = car(seed, number)[1], tuple(p.position for p in poses)
        return BoxTrack(f"car {number + 1}", "car", size, tuple(times.tolist()), positions, rotations)

    return tuple(track(number) for number in range(cars))


def with_edits(stage: SyntheticStage, edits: TrackEdits, time: float, seed: int = 0) -> World:
    """The truth of an edited scene at a time: its cars moved, turned, removed, added or swapped.

    seed: of the stage
    """
    parts = list(square())
    for node in nodes_of(stage.tracks, edits):
        pose = node.track.pose(time)
        if pose is not None:
            at = Pose(tuple(pose[:, 3].tolist()), nested(pose[:, :3].numpy()))
            own = car(seed, int(node.like.split()[-1]) - 1)[0]
            parts += [replace(part, pose=at @ part.pose, name=node.name) for part in own]
    return World(tuple(parts), (SUN,), SKY)


def stage(size: int = 160, views: int = 60, seed: int = 0, cars: int = 4) -> SyntheticStage:
    random = np.random.default_rng(seed)
    aside = random.normal(0, 2.0, 2)
    moments = np.linspace(0, 1, max(views, 2))
    between_two = 0.5 * (moments[:-1] + moments[1:])[BETWEEN // 2 :: BETWEEN]

    def taken(times: np.ndarray):
        across = np.radians(-90.0 + aside[0] + SWEEP * np.sin(2 * math.pi * (times - 0.25)))
        up = np.radians(ELEVATION + CLIMB * np.cos(4 * math.pi * times) + aside[1])
        eyes = [sphere_point(a, b, DISTANCE) for a, b in zip(across, up, strict=True)]
        poses = np.stack([look_at(eye, (0.0, 0.05, -0.12)) for eye in eyes])
        return timed(pinhole(poses, size, FIELD_OF_VIEW), times)

    cameras = {"train": taken(moments), "test": taken(between_two)}
    every = np.unique(np.concatenate([x.time.double().numpy() for x in cameras.values()]))
    bounds = ((-1.0, -1.0, GROUND - 0.02), (1.0, 1.0, 0.5))
    moving = partial(world, seed, cars)
    return SyntheticStage(
        moving(0.0), cameras, bounds, reach=4.0, near=0.4, moving=moving, tracks=tracks(seed, cars, every)
    )
