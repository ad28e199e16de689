"""The light of a drive: a sun that goes across the sky, a cloud before it, and how long cameras exposed."""

from __future__ import annotations

import math
from dataclasses import replace

from ...world import Sky, Sun
from ..tourists import Day

SWEEP = (-60.0, 75.0)  # azimuth of the sun as the drive begins and ends, degrees
MIN_ELEVATION, MAX_ELEVATION = 30.0, 58.0  # of the sun at the ends of the drive, and half-way
CLOUD = (0.45, 0.12, 0.75)  # when a cloud is before the sun, for how long (shares of the drive), what it takes
WHITE = (1.0, 1.0, 1.0)
EXPOSURE_STOPS = 0.55  # amplitude by which the cameras' exposure follows the scene
EXPOSURE_CYCLES = 5  # per drive


def day(share: float, exposure: float) -> Day:
    """The light when a share of the drive is over."""
    begin, end = SWEEP
    middle, width, most = CLOUD
    overcast = most * math.exp(-(((share - middle) / width) ** 2))
    sun = begin + share * (end - begin), MIN_ELEVATION + (MAX_ELEVATION - MIN_ELEVATION) * math.sin(math.pi * share)
    return Day(sun, overcast, WHITE, exposure)


def lights(today: Day) -> tuple[Sun]:
    return today.lights


def sky(today: Day) -> Sky:
    """Sky of a world in metres: hardly any haze, ambient occlusion within arm's reach."""
    return replace(today.sky, haze=0.0012, reach=1.5)


def exposure(share: float, gain: float) -> float:
    """Light that one camera of the rig takes, of what it would take otherwise. gain: its own factor"""
    return gain * 2 ** (EXPOSURE_STOPS * math.sin(2 * math.pi * EXPOSURE_CYCLES * share))
