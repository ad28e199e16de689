"""Cars that drive about while the city is photographed. Lengths in metres, times in seconds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from ...world import Object, Pose
from .plan import LANE, OUTSKIRTS, PITCH, Crossing
from .streets import car

CAR_SPACING = 26.0  # metres of a lane per car
MIN_SPEED, MAX_SPEED = 5.0, 11.0  # metres per second
MIN_CAR_DISTANCE = 6.0  # between the centres of two cars
MIN_CAMERA_DISTANCE = 7.5  # from the car with the cameras

TRAFFIC = "traffic"


@dataclass(frozen=True)
class Lane:
    """A straight way through the whole city: where it begins, which way it leads (degrees), how long it is."""

    begin: tuple[float, float]
    turn: float
    length: float


@dataclass(frozen=True)
class Driver:
    """A car on its lane: where it was at the beginning, how quick it is, what it is like."""

    lane: Lane
    start: float
    speed: float
    seed: int

    def pose(self, time: float) -> Pose:
        way = (self.start + self.speed * time) % self.lane.length
        return Pose.at(*self.lane.begin, 0, turn=self.lane.turn) @ Pose.at(way, 0, 0)


def lanes(places: list[Crossing]) -> Iterator[Lane]:
    """Both lanes of every street, which goes on to the outskirts."""
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
    """The cars on the streets at a moment, but for those in another's way. eye: where the photographs are taken"""
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
    return tuple(car(Pose(), np.random.default_rng(seed), TRAFFIC))
