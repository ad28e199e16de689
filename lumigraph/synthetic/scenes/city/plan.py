"""A city's plan: crossings on a grid, streets between neighbours, and a drive along all of them. Lengths in metres."""

import math

import numpy as np
from jaxtyping import Float

from ...world import Vector

PITCH = 36.0  # between neighbouring crossings
ROAD = 5.0  # half the width of a street, from its middle to the kerb
PAVEMENT = 2.5  # from the kerb to the houses
LANE = 1.5  # from the middle of the street to the middle of a lane; people drive on the right
BEND = 0.55  # of the way across a crossing: where the handles of the curve through it stand (a quarter of a circle)
TANGENT_STEP = 0.5  # metres before and behind, between which the drive's direction is measured

OUTSKIRTS = 40.0  # how far asphalt goes beyond the outermost crossings
MAX_HEIGHT = 20.0  # of houses

Crossing = tuple[int, int]  # column and row


def crossings(count: int) -> list[Crossing]:
    """`count` crossings in a square grid, the last row maybe shorter."""
    columns = math.ceil(math.sqrt(count))
    return [(k % columns, k // columns) for k in range(count)]


def extent(count: int) -> tuple[Vector, Vector]:
    """Two corners of the city's box, the ground included."""
    places = crossings(count)
    columns, rows = (max(place[axis] for place in places) + 1 for axis in range(2))
    out = (PITCH * (columns - 1) + OUTSKIRTS, PITCH * (rows - 1) + OUTSKIRTS, MAX_HEIGHT)
    return (-OUTSKIRTS, -OUTSKIRTS, -0.4), out


def neighbours(places: list[Crossing]) -> dict[Crossing, list[Crossing]]:
    """Neighbouring crossings of each crossing."""
    return {
        (i, j): [there for there in ((i + 1, j), (i, j + 1), (i - 1, j), (i, j - 1)) if there in places]
        for i, j in places
    }


def tour(places: list[Crossing]) -> list[Crossing]:
    """An Eulerian tour along every street once in each direction, straight on where possible (Hierholzer 1873)."""
    onward = neighbours(places)
    way, done = [places[0]], []
    while way:
        here = way[-1]
        if not onward[here]:
            done.append(way.pop())
            continue
        before = way[-2] if len(way) > 1 else (here[0] - 1, here[1])
        there = max(onward[here], key=lambda to: straightness(before, here, to))
        onward[here].remove(there)
        way.append(there)
    return done[::-1]


def straightness(before: Crossing, here: Crossing, there: Crossing) -> int:
    """1 straight on, 0 for a turn, -1 for going back."""
    return (here[0] - before[0]) * (there[0] - here[0]) + (here[1] - before[1]) * (there[1] - here[1])


def track(places: list[Crossing]) -> Float[np.ndarray, "point 2"]:
    """The drive as a closed line: along the lanes, with curves over the crossings."""
    round_trip = tour(places)
    corners = PITCH * np.array(round_trip, float)
    way = np.diff(corners, axis=0) / PITCH
    beside = LANE * np.stack([way[:, 1], -way[:, 0]], -1)
    begin, end = corners[:-1] + ROAD * way + beside, corners[1:] - ROAD * way + beside
    line = []
    for k in range(len(way)):
        after = (k + 1) % len(way)
        line += [begin[k : k + 1], curve(end[k], way[k], begin[after], way[after])]
    return np.concatenate([*line, begin[:1]])


def curve(start: np.ndarray, way: np.ndarray, stop: np.ndarray, onward: np.ndarray) -> Float[np.ndarray, "point 2"]:
    """Nine points of the cubic Bezier curve from one lane to another."""
    handle = BEND * np.abs(stop - start).max()
    t = np.linspace(0, 1, 9)[:, None]
    a, b = start + handle * way, stop - handle * onward
    return (1 - t) ** 3 * start + 3 * (1 - t) ** 2 * t * a + 3 * (1 - t) * t**2 * b + t**3 * stop


def stops(places: list[Crossing], count: int) -> tuple[Float[np.ndarray, "stop 2"], Float[np.ndarray, " stop"], float]:
    """Evenly spaced positions of a drive; headings, radians; its length."""
    line = track(places)
    gone = np.concatenate([[0.0], np.linalg.norm(np.diff(line, axis=0), axis=-1).cumsum()])

    def at(way: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(way % gone[-1], gone, line[:, axis]) for axis in range(2)], -1)

    way = (np.arange(count) + 0.5) / count * gone[-1]
    ahead = at(way + TANGENT_STEP) - at(way - TANGENT_STEP)
    return at(way), np.arctan2(ahead[:, 1], ahead[:, 0]), float(gone[-1])
