"""Captions of plain objects, "a red cube beside a blue ball", and pictures of them: training data of a text-and-image
model, with held-out pairs of objects."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from ..system.progress import track
from .cameras import look_at, pinhole, sphere_point
from .rendering import eight_bits, photograph
from .shapes import Ball, Cone, Cuboid, SolidShape
from .textures import Plain
from .world import Material, Object, Pose, Sky, Sun, World

COLOURS = {
    "red": (0.84, 0.10, 0.09),
    "yellow": (0.93, 0.80, 0.10),
    "green": (0.12, 0.62, 0.16),
    "blue": (0.10, 0.24, 0.82),
    "purple": (0.56, 0.14, 0.66),
}
SHAPES = "ball", "cube", "cone"
HELD_OUT = 20  # pairs of things that no training caption has
SIZE_SHARES = 0.4, 0.5, 0.1  # of groups of one, two and three things
BETWEEN = " beside "
DISTANCE = 4.0  # scene units from camera to origin
ELEVATIONS = 10.0, 50.0  # degrees above the horizon
FIELDS_OF_VIEW = 25.0, 31.0  # degrees
SKIES = Sky((0.95, 0.97, 1.0), (0.97, 0.96, 0.95), (0.75, 0.72, 0.68), light=0.75)


@dataclass(frozen=True, order=True)
class Thing:
    colour: str
    shape: str

    def __str__(self) -> str:
        return f"a {self.colour} {self.shape}"

    def solid(self, radius: float) -> SolidShape:
        """The shape, about `radius` from its centre to its sides."""
        shapes = {
            "ball": Ball(radius),
            "cube": Cuboid((0.85 * radius,) * 3, 0.04 * radius),
            "cone": Cone(radius, 0.0, 1.1 * radius, 0.03 * radius),
        }
        return shapes[self.shape]


THINGS = tuple(Thing(colour, shape) for colour, shape in itertools.product(COLOURS, SHAPES))
Group = tuple[Thing, ...]


def caption(group: Group) -> str:
    """ "a red cube beside a blue ball"."""
    return BETWEEN.join(map(str, group))


def pairs() -> list[Group]:
    """All pairs of objects of different colour and shape, each once, in a fixed random order."""
    found = [(a, b) for a, b in itertools.combinations(THINGS, 2) if a.colour != b.colour and a.shape != b.shape]
    return [found[i] for i in np.random.default_rng(0).permutation(len(found))]


def held_out() -> list[Group]:
    """Held-out pairs, in no training caption, alone or with a third object."""
    return pairs()[:HELD_OUT]


def training_groups(random: np.random.Generator, count: int) -> Iterator[Group]:
    """Training groups of one, two or three objects, without held-out pairs."""
    never = {frozenset(pair) for pair in held_out()}
    while count:
        size = random.choice(3, p=SIZE_SHARES) + 1
        group = tuple(THINGS[i] for i in random.choice(len(THINGS), size, replace=False))
        if not any(frozenset(pair) in never for pair in itertools.combinations(group, 2)):
            count -= 1
            yield group


def world(group: Group, random: np.random.Generator) -> World:
    """Objects in a row on an invisible floor, at a random angle."""
    radii = random.uniform(0.32, 0.45, len(group)) * (1.0 if len(group) < 3 else 0.8)
    places = np.cumsum([0.0, *(radii[:-1] + radii[1:] + random.uniform(0.02, 0.2, len(group) - 1))])
    places = (places - places.mean()) if len(group) > 1 else random.uniform(-0.1, 0.1, 1)
    turn = random.uniform(0, 2 * np.pi)
    objects = []
    for thing, radius, place in zip(group, radii, places, strict=True):
        solid, aside = thing.solid(radius), random.normal(0, 0.04)
        x, y = place * np.cos(turn) - aside * np.sin(turn), place * np.sin(turn) + aside * np.cos(turn)
        colour = tuple(np.clip(np.array(COLOURS[thing.colour]) + random.normal(0, 0.04, 3), 0.0, 1.0).tolist())
        material = Material(Plain(colour), gloss=random.uniform(0.0, 0.3), roughness=0.5)
        pose = Pose.at(x, y, solid.describe()[3][2] - 0.4, turn=random.uniform(0, 360))
        objects.append(Object(solid, material, pose, str(thing)))
    direction = sphere_point(random.uniform(0, 2 * np.pi), random.uniform(0.5, 1.3))
    sun = Sun(tuple(direction.tolist()), 0.3, random.uniform(0.1, 0.5))
    return World(tuple(objects), (sun,), SKIES)


def picture(group: Group, size: int, random: np.random.Generator) -> UInt8[np.ndarray, "size size 4"]:
    """Picture of the objects from a random side, with straight alpha."""
    eye = sphere_point(random.uniform(0, 2 * np.pi), np.radians(random.uniform(*ELEVATIONS)), DISTANCE)
    camera = pinhole(look_at(eye, random.normal(0, 0.06, 3))[None], size, random.uniform(*FIELDS_OF_VIEW))
    return eight_bits(*photograph(world(group, random), camera, samples=4, more=0), alpha=True)


def pictures(groups: Sequence[Group], size: int, seed: int) -> UInt8[np.ndarray, "picture size size 4"]:
    """A picture of each group, with straight alpha. The same seed gives the same pictures."""
    random = np.random.default_rng(seed)
    return np.stack([picture(group, size, random) for group in track(groups, "Tracing pictures", len(groups))])
