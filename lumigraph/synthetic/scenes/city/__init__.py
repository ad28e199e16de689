"""A city, photographed by a car with three cameras that drives along every street once in each direction: façades with
windows and shops, trees, parked cars and others that drive. The sun moves during the drive and a cloud comes before it;
each camera exposes in its own way, and differently from place to place. Every eighth photograph is held out and was
taken with nobody driving.

    procedural:city,crossings=6,views=400,size=320        pictures of 320x240, further options as everywhere

Lengths in metres, z = 0 is the road.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from typing import Annotated, Any

import numpy as np
import torch

from ....files.ranges import between
from ...cameras import look_at, pinhole
from ...options import Pictures
from ...stage import SyntheticStage
from ...world import World, joined
from . import light, plan, streets, traffic

CITY = 1  # of the pictures that are kept: another number traces them anew
HEIGHT = 2.1  # of the cameras
RIG = ((62.0, 7.0, 1.0), (0.0, 2.0, 1.3), (-62.0, 7.0, 1.7))  # to the left and up, degrees; the factor of exposure
FIELD_OF_VIEW = 74.0  # degrees, across
SPEED = 8.0  # metres per second
HOLD_OUT = 8
SHAPE = 0.75  # height of a picture, of its width
ERROR = 10.0  # metres of which errors of poses are so many percent: a street's width


@dataclass(frozen=True)
class Options(Pictures):
    """Options of every scene, but for these.

    size:      width of the pictures, which are three quarters as high
    crossings: of streets; around each is as much of the city as one block of a large scene may hold
    jitter_poses: degrees, and percent of a street's width
    """

    size: Annotated[int, between(8, 8192)] = 320
    views: Annotated[int, between(1, 100_000)] = 400
    crossings: Annotated[int, between(2, 400)] = 6


@dataclass(frozen=True)
class Drive:
    """A drive through a city of so many crossings, with so many photographs.

    photographs: held-out ones included
    """

    crossings: int
    photographs: int
    seed: int

    def share(self, number: int) -> float:
        """Share of the drive that is over when a photograph is taken."""
        return (number // len(RIG) + 0.5) / self.stops

    @property
    def stops(self) -> int:
        return -(-self.photographs // len(RIG))

    def exposure(self, number: int) -> float:
        return light.exposure(self.share(number), RIG[number % len(RIG)][2])

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
        """The city as one photograph finds it. lasting: without cars that drive"""
        today = light.day(self.share(number), self.exposure(number))
        parts = [still(self.crossings, self.seed)]
        if not lasting:
            parts.append(driving(self, number // len(RIG)))
        return joined(parts, light.lights(today), light.sky(today))


@cache
def still(crossings: int, seed: int) -> World:
    return streets.standing(plan.crossings(crossings), seed)


@lru_cache(16)
def driving(drive: Drive, stop: int) -> World:
    """Who drives about while the rig takes its photographs."""
    eye = route(drive.crossings, drive.stops)[0][stop]
    return World(tuple(traffic.traffic(everybody(drive.crossings, drive.seed), drive.time(stop * len(RIG)), eye)))


@cache
def everybody(crossings: int, seed: int) -> list[traffic.Driver]:
    return traffic.drivers(plan.crossings(crossings), seed)


@cache
def route(crossings: int, stops: int) -> tuple[np.ndarray, np.ndarray, float]:
    return plan.stops(plan.crossings(crossings), stops)


def stage(size: int = 320, views: int = 400, seed: int = 0, crossings: int = 6) -> SyntheticStage:
    """The city, seen along one drive: so many photographs to learn from, and after every seventh one that is not."""
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
