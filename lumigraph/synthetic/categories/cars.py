"""Cars: a body, a cabin with windows, four wheels, lamps; some are vans, some carry a bed behind the cabin."""

from collections.abc import Iterator

import numpy as np

from ..shapes import Ball, Cuboid, Cylinder, SolidShape
from ..textures import Plain
from ..world import Material, Object, Pose
from .parts import GLASS, RUBBER, STEEL, colour, paint

BOUNDS = ((-0.95, -0.95, -0.5), (0.95, 0.95, 0.5))
ASIDE = Pose.about((1, 0, 0), 90)  # turns an upright shape along y
LAMP, TAIL = Material(Plain((0.98, 0.95, 0.80)), gloss=1.0), Material(Plain((0.75, 0.08, 0.08)), gloss=1.0)


def objects(random: np.random.Generator, astray: float = 25.0) -> Iterator[Object]:
    """One car, centred. It faces -x, within `astray` degrees."""
    long, wide = random.uniform(0.62, 0.8), random.uniform(0.27, 0.34)
    wheel, body, cabin = random.uniform(0.10, 0.145), random.uniform(0.10, 0.15), random.uniform(0.10, 0.16)
    floor = 0.8 * wheel
    turn = Pose.at(0, 0, -0.5 * (floor + 2 * body + 2 * cabin), turn=random.uniform(-astray, astray))
    main = paint(colour(random, (0.1, 0.9)))
    roof = main if random.uniform() < 0.6 else paint(colour(random, (0.0, 0.5)))

    def part(shape: SolidShape, material: Material, x: float, y: float, z: float, turned: Pose | None = None) -> Object:
        place = turn @ Pose.at(x, y, z)
        return Object(shape, material, place @ turned if turned else place, "car")

    kind = random.uniform()  # saloon, van or pick-up
    share = 0.52 if kind < 0.5 else 0.85 if kind < 0.75 else 0.34
    middle = 0.06 * long if kind < 0.5 else 0.1 * long if kind < 0.75 else -0.18 * long
    z = floor + body
    yield part(Cuboid((long, wide, body), 0.05), main, 0, 0, z)
    above = z + body + cabin - 0.03
    yield part(Cuboid((share * long, 0.9 * wide, cabin), 0.05), roof, middle, 0, above)
    tall = 0.55 * cabin
    yield part(Cuboid((0.82 * share * long, 0.9 * wide + 0.008, tall), 0.01), GLASS, middle, 0, above)
    yield part(Cuboid((share * long + 0.008, 0.76 * wide, tall), 0.01), GLASS, middle, 0, above)
    if kind >= 0.75:
        yield part(Cuboid((0.36 * long, 0.78 * wide, 0.02)), RUBBER, 0.56 * long, 0, z + body)
    axle = random.uniform(0.58, 0.68) * long
    hub = STEEL if random.uniform() < 0.6 else paint(colour(random))
    for x in (-1, 1):
        for y in (-1, 1):
            yield part(Cylinder(wheel, 0.05, rounding=0.015), RUBBER, x * axle, y * (wide - 0.02), wheel, ASIDE)
            yield part(Cylinder(0.55 * wheel, 0.055), hub, x * axle, y * (wide - 0.02), wheel, ASIDE)
    lamp = random.uniform(0.04, 0.06)
    for y in (-1, 1):
        yield part(Ball(lamp), LAMP, -long + 0.01, 0.7 * y * wide, z + 0.1 * body)
        yield part(Cuboid((0.015, 0.05, 0.03), 0.005), TAIL, long, 0.75 * y * wide, z + 0.2 * body)
    if random.uniform() < 0.5:
        yield part(Cuboid((0.03, 0.95 * wide, 0.03), 0.01), STEEL, -long - 0.01, 0, floor + 0.04)
