"""Chairs: a seat on legs or a column, a back of board, slats or rods, sometimes arms."""

from collections.abc import Iterator

import numpy as np

from ..shapes import Cuboid, Cylinder, SolidShape
from ..world import Object, Pose
from .parts import STEEL, finish, timber

BOUNDS = ((-0.7, -0.7, -0.9), (0.7, 0.7, 0.9))


def objects(random: np.random.Generator) -> Iterator[Object]:
    """One chair, centred. Its back is at about +y."""
    wide, deep, thick = random.uniform(0.34, 0.5), random.uniform(0.34, 0.48), random.uniform(0.03, 0.07)
    seat, back = random.uniform(0.55, 0.8), random.uniform(0.5, 0.8)
    turn = Pose.at(0, 0, -0.5 * (seat + back), turn=random.uniform(-25, 25))
    frame = timber(random) if random.uniform() < 0.6 else STEEL if random.uniform() < 0.5 else finish(random)
    cloth = finish(random)

    def part(shape: SolidShape, material, x: float, y: float, z: float, tilt: float = 0.0) -> Object:
        return Object(shape, material, turn @ Pose.at(x, y, z, tilt=tilt), "chair")

    round_seat = random.uniform() < 0.25
    top = Cylinder(wide, thick, rounding=0.02) if round_seat else Cuboid((wide, deep, thick), 0.025)
    yield part(top, cloth, 0, 0, seat - thick)
    leg, inset = random.uniform(0.025, 0.05), 0.7 if round_seat else 0.88
    under = 0.5 * (seat - 2 * thick)
    if random.uniform() < 0.2:
        yield part(Cylinder(leg, under), frame, 0, 0, under)
        yield part(Cylinder(0.75 * wide, 0.025, rounding=0.01), frame, 0, 0, 0.025)
    else:
        straight = random.uniform() < 0.5
        for x in (-1.0, 1.0):
            for y in (-1.0, 1.0):
                shape = Cuboid((leg, leg, under), 0.008) if straight else Cylinder(leg, under)
                yield part(shape, frame, x * (inset * wide - leg), y * (inset * deep - leg), under)
    lean, kind = random.uniform(0, 10), random.uniform()
    y, middle = inset * deep - 0.03, seat + 0.5 * back
    shift = y + 0.5 * back * np.tan(np.radians(lean))
    if kind < 0.4:
        yield part(Cuboid((0.9 * wide, 0.03, 0.5 * back), 0.02), cloth, 0, shift, middle, tilt=-lean)
    else:
        for x in (-1.0, 1.0):
            yield part(Cuboid((leg, 0.03, 0.5 * back), 0.008), frame, x * (0.85 * wide), shift, middle, tilt=-lean)
        count = int(random.integers(2, 5))
        for i in range(count):
            share = (i + 1) / count
            lying = kind < 0.7
            if lying:
                z, slant = seat + share * back - 0.06, y + share * back * np.tan(np.radians(lean))
                yield part(Cuboid((0.85 * wide, 0.02, 0.05), 0.01), cloth, 0, slant, z, tilt=-lean)
            else:
                x = 0.85 * wide * (2 * (i + 0.5) / count - 1)
                yield part(Cylinder(0.025, 0.5 * back), frame, x, shift, middle, tilt=-lean)
        yield part(Cuboid((0.9 * wide, 0.03, 0.05), 0.01), frame, 0, shift + 0.5 * back * np.tan(np.radians(lean)),
                   seat + back, tilt=-lean)  # fmt: skip
    if random.uniform() < 0.4:
        height = random.uniform(0.18, 0.28)
        for x in (-1, 1):
            yield part(Cuboid((0.04, 0.85 * deep, 0.02), 0.01), frame, x * wide, 0, seat + height)
            yield part(Cylinder(0.025, 0.5 * height), frame, x * wide, -0.7 * deep, seat + 0.5 * height)
