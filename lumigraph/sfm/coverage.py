"""Coverage of a subject by photographs: the angle around it, gaps, elevations, and positions for more photographs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from ..files.names import counted
from ..readers.normalise import where_axes_meet

Place = tuple[float, float, float]

MAX_GAP_ANGLE = 30.0  # degrees between neighbouring viewing directions
ADVISED_STEP = 20.0  # degrees between photographs that fill a gap
MIN_ORBIT = 180.0  # degrees between the outermost photographs, from which on gaps and elevations are judged
STEP_ELEVATION = 10.0  # degrees of elevation that count as a step higher or lower
MIN_BAND = 15.0  # degrees between the lowest and the highest tenth of the elevations; less is a single round
ROUND_ELEVATION = 25.0  # degrees above or below the first round that a second one is advised at
LOW_ROUND = 20.0  # degrees; a round below it is advised to be followed by one higher, others by one lower
ROUND_PHOTOGRAPHS = 12
FRONT_ANGLE = 60.0  # degrees covered, up to which photographs show a front


@dataclass(frozen=True)
class Gap:
    """Directions without a photograph: degrees around the vertical, and the photographs at both ends."""

    degrees: float
    between: tuple[str, str]


@dataclass(frozen=True)
class Coverage:
    """Angle of the subject that photographs cover. Gaps and advice only where they span more than half of the circle.

    elevations: lowest and highest camera, degrees above the horizontal through the subject
    advice:     photographs to add, one sentence part each: "4 more from behind, between a.jpg and b.jpg"
    places:     positions of these photographs, in the frame of the cameras
    ends:       first and last photograph, from left to right, if these span at most half of the circle
    """

    degrees: float
    gaps: list[Gap] = field(default_factory=list)
    elevations: tuple[float, float] = (0.0, 0.0)
    advice: list[str] = field(default_factory=list)
    places: list[Place] = field(default_factory=list)
    ends: tuple[str, str] | None = None


def use_of(degrees: float, ends: Sequence[str] | None) -> str:
    """Views possible with an angle around the subject, and positions of photographs for others.

    ends: see `Coverage`
    """
    if ends is None:
        return "enough for views from all sides" if degrees >= 360 else "enough for views from most sides"
    count = math.ceil((360 - degrees) / ADVISED_STEP) - 1
    enough = "a front, such as a facade" if degrees <= FRONT_ANGLE else "one side of an object"
    return (
        f"enough for views of {enough}, from between {' and '.join(ends)}; for all sides take "
        f"{counted(count, 'photograph')} more around the rest, one every {ADVISED_STEP:.0f} degrees"
    )


def coverage(names: Sequence[str], poses: Float[np.ndarray, "photo 3 4"]) -> Coverage | None:
    """Coverage around the vertical (+z) through the subject of the cameras; None where their axes do not meet.

    poses: camera-to-world
    Directions nearer to each other than 30 degrees cover the angle between them. The first photograph is the front.
    """
    subject, converging = where_axes_meet(poses[:, :, 3], poses[:, :, 2])
    if not converging:
        return None
    away = poses[:, :, 3] - subject
    azimuth = np.degrees(np.arctan2(away[:, 1], away[:, 0]))
    radius = np.linalg.norm(away, axis=-1)
    elevation = np.degrees(np.arcsin((away[:, 2] / radius.clip(1e-12)).clip(-1, 1)))
    order = np.argsort(azimuth)
    steps = np.diff(azimuth[order], append=azimuth[order[0]] + 360)
    wide = [i for i in np.argsort(-steps).tolist() if steps[i] > MAX_GAP_ANGLE]
    degrees = float(360 - steps[wide].sum())
    band = float(elevation.min()), float(elevation.max())
    if steps.max() >= 360 - MIN_ORBIT:
        last, first = order[wide[0]], order[(wide[0] + 1) % len(order)]
        return Coverage(degrees, [], band, ends=(names[first], names[last]))
    gaps, advice, places, usual = [], [], [], float(np.median(elevation))
    for i in wide:
        ends = order[i], order[(i + 1) % len(order)]
        between = names[ends[0]], names[ends[1]]
        gaps.append(Gap(float(steps[i]), between))
        count = max(1, math.ceil(steps[i] / ADVISED_STEP) - 1)
        share = np.arange(1, count + 1) / (count + 1)
        height, distance = (np.interp(share, [0, 1], values[list(ends)]) for values in (elevation, radius))
        places += around(subject, azimuth[ends[0]] + share * steps[i], height, distance)
        side = side_of(azimuth[ends[0]] + steps[i] / 2 - azimuth[0])
        level = level_of(float(elevation[list(ends)].mean()) - usual)
        advice.append(f"{count} more from {side}{level}: between {between[0]} and {between[1]}")
    low, high = np.percentile(elevation, [10, 90])
    if high - low < MIN_BAND:
        turn = ROUND_ELEVATION if usual < LOW_ROUND else -ROUND_ELEVATION
        every = np.full(ROUND_PHOTOGRAPHS, usual + turn)
        distance = np.full(ROUND_PHOTOGRAPHS, float(np.median(radius)))
        places += around(subject, azimuth[0] + 360 * np.arange(ROUND_PHOTOGRAPHS) / ROUND_PHOTOGRAPHS, every, distance)
        advice.append(
            f"a second round of {counted(ROUND_PHOTOGRAPHS, 'photograph')}{level_of(turn)}: all are from "
            f"{band[0]:.0f} to {band[1]:.0f} degrees above the subject"
        )
    return Coverage(degrees, gaps, band, advice, places)


def around(
    subject: Float[np.ndarray, " 3"],
    azimuth: Float[np.ndarray, " place"],
    elevation: Float[np.ndarray, " place"],
    radius: Float[np.ndarray, " place"],
) -> list[Place]:
    """Positions around a subject; angles in degrees."""
    a, e = np.radians(azimuth), np.radians(elevation)
    found = subject + radius[:, None] * np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1)
    return [(x, y, z) for x, y, z in found.tolist()]


def side_of(degrees: float) -> str:
    """Side of the subject, from the direction of the first photograph, counterclockwise from above."""
    turn = (degrees + 180) % 360 - 180
    if abs(turn) < 45:
        return "the front"
    return "behind" if abs(turn) > 135 else "the right" if turn > 0 else "the left"


def level_of(degrees: float) -> str:
    """Words for a difference in elevation; empty for less than a step."""
    if abs(degrees) < STEP_ELEVATION:
        return ""
    return ", a step higher" if degrees > 0 else ", a step lower"
