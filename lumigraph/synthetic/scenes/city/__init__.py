"""A city, photographed by a car with three cameras that drives along every street once in each direction: façades with
windows and shops, trees, parked cars and moving ones. The sun moves during the drive and a cloud covers it; each camera
has its own exposure, which varies with the position. Every eighth photograph is held out and shows no moving cars.

    procedural:city,crossings=6,views=400,size=320        pictures of 320x240, further options as everywhere

Lengths in metres, z = 0 is the road.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from typing import Annotated, Any

import numpy as np
import torch

from ....files.ranges import between
from ...cameras import look_at, pinhole
from ...stage import Pictures, SyntheticStage
from ...world import Object, Pose, World, joined
from ..tourists import Day
from . import plan
from .plan import LANE, OUTSKIRTS, PITCH, Crossing
from .streets import car, standing

CITY = 1  # of the pictures that are kept: another number traces them anew
HEIGHT = 2.1  # of the cameras
RIG = ((62.0, 7.0, 1.0), (0.0, 2.0, 1.3), (-62.0, 7.0, 1.7))  # to the left and up, degrees; the factor of exposure
FIELD_OF_VIEW = 74.0  # degrees, across
SPEED = 8.0  # metres per second
HOLD_OUT = 8
SHAPE = 0.75  # height of a picture, of its width
ERROR = 10.0  # metres of which errors of poses are so many percent: a street's width
SWEEP = (-60.0, 75.0)  # azimuth of the sun as the drive begins and ends, degrees
MIN_ELEVATION, MAX_ELEVATION = 30.0, 58.0  # of the sun at the ends of the drive, and half-way
CLOUD = (0.45, 0.12, 0.75)  # when a cloud is before the sun, for how long (shares of the drive), what it takes
EXPOSURE_STOPS = 0.55  # amplitude by which the cameras' exposure follows the scene
EXPOSURE_CYCLES = 5  # per drive
CAR_SPACING = 26.0  # metres of a lane per car
MIN_SPEED, MAX_SPEED = 5.0, 11.0  # metres per second
MIN_CAR_DISTANCE = 6.0  # between the centres of two cars
MIN_CAMERA_DISTANCE = 7.5  # from the car with the cameras


@dataclass(frozen=True)
class Options(Pictures):
    """Options of every scene, but for these.

    size:      width of the pictures, which are three quarters as high
    crossings: number of street crossings; one block of a large scene contains the surroundings of one
    jitter_poses: degrees, and percent of a street's width
    """

    size: Annotated[int, between(8, 8192)] = 320
    views: Annotated[int, between(1, 100_000)] = 400
    crossings: Annotated[int, between(2, 400)] = 6


@dataclass(frozen=True)
class Drive:
    """A drive through a city of some crossings.

    photographs: number of photographs, held-out ones included
    """

    crossings: int
    photographs: int
    seed: int

    def share(self, number: int) -> float:
        """Position of a photograph in the drive, from 0 to 1."""
        return (number // len(RIG) + 0.5) / self.stops

    @property
    def stops(self) -> int:
        return -(-self.photographs // len(RIG))

    def exposure(self, number: int) -> float:
        """Exposure factor of a photograph's camera."""
        gain = RIG[number % len(RIG)][2]
        return gain * 2 ** (EXPOSURE_STOPS * math.sin(2 * math.pi * EXPOSURE_CYCLES * self.share(number)))

    def time(self, number: int) -> float:
        """Seconds since the drive began."""
        return self.share(number) * route(self.crossings, self.stops)[2] / SPEED

    def pose(self, number: int) -> np.ndarray:
        places, headings, _ = route(self.crossings, self.stops)
        place, heading = places[number // len(RIG)], headings[number // len(RIG)]
        aside, up, _ = RIG[number % len(RIG)]
        way, tilt = heading + math.radians(aside), math.radians(up)
        eye = np.array([*place, HEIGHT])
        gaze = (math.cos(way) * math.cos(tilt), math.sin(way) * math.cos(tilt), math.sin(tilt))
        return look_at(eye, eye + gaze)

    def world(self, number: int, lasting: bool) -> World:
        """The city in one photograph. lasting: without moving cars

        Its lengths are metres: the sky has hardly any haze, and ambient occlusion has a reach of about a metre.
        """
        today = day(self.share(number), self.exposure(number))
        parts = [still(self.crossings, self.seed)]
        if not lasting:
            parts.append(driving(self, number // len(RIG)))
        return joined(parts, today.lights, replace(today.sky, haze=0.0012, reach=1.5))


@cache
def still(crossings: int, seed: int) -> World:
    return standing(plan.crossings(crossings), seed)


@lru_cache(16)
def driving(drive: Drive, stop: int) -> World:
    """Moving cars at the times of the photographs."""
    eye = route(drive.crossings, drive.stops)[0][stop]
    return World(tuple(traffic(everybody(drive.crossings, drive.seed), drive.time(stop * len(RIG)), eye)))


@cache
def everybody(crossings: int, seed: int) -> list[Driver]:
    return drivers(plan.crossings(crossings), seed)


@cache
def route(crossings: int, stops: int) -> tuple[np.ndarray, np.ndarray, float]:
    return plan.stops(plan.crossings(crossings), stops)


def stage(size: int = 320, views: int = 400, seed: int = 0, crossings: int = 6) -> SyntheticStage:
    """The city, seen along one drive: `views` training photographs, and after every seventh one a held-out one."""
    count = views + max(views // (HOLD_OUT - 1), 1)
    drive = Drive(crossings, count, seed)
    held_out = np.arange(count) % HOLD_OUT == HOLD_OUT - 1
    held_out[-1] |= not held_out.any()
    numbers = np.concatenate([np.flatnonzero(~held_out), np.flatnonzero(held_out)])
    poses = np.stack([drive.pose(int(number)) for number in numbers])
    cameras = pinhole(poses, (size, max(round(SHAPE * size), 1)), FIELD_OF_VIEW)
    cameras = replace(cameras, image_index=torch.arange(count))

    def found(image: int, lasting: bool) -> World:
        return drive.world(int(numbers[image]), lasting or image >= views)

    def known(image: int) -> dict[str, Any]:
        number = int(numbers[image])
        return {"exposure": drive.exposure(number), "time": drive.time(number)}

    def called(image: int) -> str:
        return f"city {CITY} {drive} {numbers[image]} {image >= views}"

    low, high = plan.extent(crossings)
    return SyntheticStage(
        drive.world(0, lasting=False),
        {"train": cameras[:views], "test": cameras[views:]},
        (low, high),
        reach=4 * max(b - a for a, b in zip(low, high, strict=True)) / 2,
        near=0.6,
        differing=partial(found, lasting=False),
        lasting=partial(found, lasting=True),
        facts=known,
        called=called,
        error=ERROR,
    )


def day(share: float, exposure: float) -> Day:
    """Light at a share of the drive."""
    begin, end = SWEEP
    middle, width, most = CLOUD
    overcast = most * math.exp(-(((share - middle) / width) ** 2))
    sun = begin + share * (end - begin), MIN_ELEVATION + (MAX_ELEVATION - MIN_ELEVATION) * math.sin(math.pi * share)
    return Day(sun, overcast, (1.0, 1.0, 1.0), exposure)


@dataclass(frozen=True)
class Lane:
    """A straight lane through the whole city: start, direction (degrees), length."""

    begin: tuple[float, float]
    turn: float
    length: float


@dataclass(frozen=True)
class Driver:
    """A car on its lane: initial position, speed, appearance."""

    lane: Lane
    start: float
    speed: float
    seed: int

    def pose(self, time: float) -> Pose:
        way = (self.start + self.speed * time) % self.lane.length
        return Pose.at(*self.lane.begin, 0, turn=self.lane.turn) @ Pose.at(way, 0, 0)


def lanes(places: list[Crossing]) -> Iterator[Lane]:
    """Both lanes of every street, extended to the outskirts."""
    columns, rows = (max(place[axis] for place in places) + 1 for axis in range(2))
    out = OUTSKIRTS - 6.0
    for j in range(rows):
        long = PITCH * (columns - 1) + 2 * out
        yield Lane((-out, PITCH * j - LANE), 0.0, long)
        yield Lane((long - out, PITCH * j + LANE), 180.0, long)
    for i in range(columns):
        long = PITCH * (rows - 1) + 2 * out
        yield Lane((PITCH * i + LANE, -out), 90.0, long)
        yield Lane((PITCH * i - LANE, long - out), 270.0, long)


def drivers(places: list[Crossing], seed: int) -> list[Driver]:
    random = np.random.default_rng([seed, 0x7AFF])
    found = []
    for lane in lanes(places):
        count = max(round(lane.length / CAR_SPACING), 1)
        starts = (np.arange(count) + random.uniform(0.2, 0.8, count)) * lane.length / count
        speed = random.uniform(MIN_SPEED, MAX_SPEED)  # nobody overtakes
        found += [Driver(lane, float(s), speed, int(random.integers(1 << 30))) for s in starts]
    return found


def traffic(everybody: list[Driver], time: float, eye: np.ndarray) -> Iterator[Object]:
    """Cars on the streets at a time, without overlaps. eye: position of the cameras"""
    there = [eye]
    for driver in everybody:
        pose = driver.pose(time)
        place = np.array(pose.position[:2])
        gaps = np.linalg.norm(np.array(there) - place, axis=-1)
        if gaps[0] > MIN_CAMERA_DISTANCE and gaps[1:].min(initial=np.inf) > MIN_CAR_DISTANCE:
            there.append(place)
            yield from (replace(part, pose=pose @ part.pose) for part in parts(driver.seed))


@cache
def parts(seed: int) -> tuple[Object, ...]:
    """Parts of one car."""
    return tuple(car(Pose(), np.random.default_rng(seed), "traffic"))
