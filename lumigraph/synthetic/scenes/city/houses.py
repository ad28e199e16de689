"""Houses: walls of plaster, brick or stone, rows of windows, shops and doors, cornices and roofs. Lengths in metres."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...shapes import Cuboid
from ...textures import Bricks, Checker, Colour, Mottle, Plain, Stripes
from ...world import Material, Object, Pose

SHOP, STOREY = 3.8, 3.1  # heights
BAY = 2.5  # from window to window, at least

PLASTERS = (
    (0.88, 0.70, 0.45), (0.83, 0.52, 0.40), (0.90, 0.86, 0.76), (0.66, 0.74, 0.70),
    (0.74, 0.66, 0.78), (0.93, 0.80, 0.62), (0.60, 0.68, 0.80), (0.78, 0.80, 0.62),
)  # fmt: skip
BRICKS = ((0.62, 0.30, 0.22), (0.72, 0.45, 0.30), (0.50, 0.25, 0.22), (0.78, 0.66, 0.50))
PAINTS = ((0.20, 0.36, 0.32), (0.55, 0.18, 0.16), (0.18, 0.26, 0.42), (0.42, 0.30, 0.20), (0.85, 0.84, 0.80))
PANES = tuple(
    Material(Plain(colour), gloss=1.0, roughness=0.2)
    for colour in ((0.10, 0.13, 0.18), (0.16, 0.20, 0.26), (0.34, 0.32, 0.30), (0.62, 0.58, 0.50))
)  # some with a curtain behind
TRIM = Material(Mottle((0.93, 0.91, 0.85), (0.76, 0.73, 0.66), size=0.8, contrast=0.7))
SLATE = Material(Stripes((0.36, 0.38, 0.42), (0.26, 0.28, 0.32), period=0.45, share=0.3))
TILES = Material(Stripes((0.66, 0.34, 0.24), (0.48, 0.23, 0.16), period=0.45, share=0.3))


@dataclass(frozen=True)
class Style:
    """Materials of a house, and half the width and height of its windows."""

    wall: Material
    socle: Material
    roof: Material
    door: Material
    shutters: Material | None
    window: tuple[float, float]
    storeys: int
    shops: bool

    @staticmethod
    def sample(random: np.random.Generator) -> Style:
        seed = float(random.uniform(0, 90))
        return Style(
            wall(random, seed),
            Material(Bricks((0.70, 0.67, 0.62), (0.50, 0.48, 0.45), length=0.9, height=0.45, joint=0.03)),
            TILES if random.uniform() < 0.5 else SLATE,
            painted(random),
            painted(random) if random.uniform() < 0.45 else None,
            (random.uniform(0.45, 0.65), random.uniform(0.75, 0.95)),
            int(random.integers(2, 5)),
            random.uniform() < 0.6,
        )

    @property
    def height(self) -> float:
        return SHOP + STOREY * self.storeys


def wall(random: np.random.Generator, seed: float) -> Material:
    """Wall of bricks, or of stained plaster."""
    if random.uniform() < 0.4:
        colour = BRICKS[random.integers(len(BRICKS))]
        return Material(Bricks(colour, (0.75, 0.72, 0.66), length=0.5, height=0.18, joint=0.03, variation=0.3))
    colour = PLASTERS[random.integers(len(PLASTERS))]
    return Material(Mottle(colour, darker(colour, 0.72), size=1.8, contrast=1.1, seed=seed))


def painted(random: np.random.Generator) -> Material:
    """Painted boards."""
    colour = PAINTS[random.integers(len(PAINTS))]
    return Material(Stripes(colour, darker(colour, 0.65), period=0.16, share=0.35), gloss=0.4, roughness=0.5)


def darker(colour: Colour, factor: float) -> Colour:
    r, g, b = (factor * x for x in colour)
    return r, g, b


def house(
    place: Pose, half: tuple[float, float], fronts: tuple[float, ...], random: np.random.Generator
) -> Iterator[Object]:
    """One house with windows on some of its sides.

    place: centre of its base; half: of its sizes along x and y
    fronts: directions of those sides, degrees from -y anticlockwise: 0, 90, 180 or 270
    """
    style = Style.sample(random)
    x, y, height = *half, style.height

    def box(
        size: tuple[float, float, float], material: Material, z: float, aside: float = 0.0, back: float = 0.0
    ) -> Object:
        return Object(Cuboid(size), material, place @ Pose.at(aside, back, z), "houses")

    yield box((x, y, 0.5 * height), style.wall, 0.5 * height)
    yield box((x + 0.05, y + 0.05, 0.35), style.socle, 0.35)
    yield box((x + 0.12, y + 0.12, 0.12), TRIM, SHOP - 0.1)
    yield box((x + 0.35, y + 0.35, 0.18), TRIM, height)
    yield box((x - 0.6, y - 0.6, 0.9), style.roof, height + 1.0)
    yield box((0.4, 0.4, 0.9), style.socle, height + 2.6, random.uniform(-0.6, 0.6) * x, random.uniform(-0.5, 0.5) * y)
    for turn in fronts:
        long, deep = (x, y) if turn % 180 == 0 else (y, x)
        yield from front(place @ Pose.at(0, 0, 0, turn=turn) @ Pose.at(0, -deep, 0), long, style, random)


def front(place: Pose, half: float, style: Style, random: np.random.Generator) -> Iterator[Object]:
    """Objects on one wall, which faces -y and is twice `half` wide: a door, shops or windows, rows of windows above."""
    bays = max(int((2 * half - 0.6) / BAY), 1)
    middles = (np.arange(bays) + 0.5 - bays / 2) * (2 * half - 0.6) / bays
    door = random.integers(bays)
    for bay, x in enumerate(middles.tolist()):
        if bay == door:
            yield Object(Cuboid((0.7, 0.06, 1.35)), style.door, place @ Pose.at(x, 0, 1.35), "doors")
            yield Object(Cuboid((0.85, 0.12, 0.12)), TRIM, place @ Pose.at(x, 0, 2.85), "doors")
        elif style.shops:
            yield from shop(place @ Pose.at(x, 0, 0), random)
        else:
            yield from window(place @ Pose.at(x, 0, 1.95), style, random)
        for storey in range(style.storeys):
            z = SHOP + (storey + 0.5) * STOREY
            yield from window(place @ Pose.at(x, 0, z), style, random)


def window(place: Pose, style: Style, random: np.random.Generator) -> Iterator[Object]:
    """A frame with two panes, a sill, maybe shutters."""
    wide, high = style.window
    pane = PANES[random.choice(len(PANES), p=(0.45, 0.3, 0.15, 0.1))]
    yield Object(Cuboid((wide + 0.1, 0.04, high + 0.1)), TRIM, place, "windows")
    for side in (-1, 1):
        yield Object(Cuboid((0.5 * wide - 0.04, 0.05, high)), pane, place @ Pose.at(0.5 * side * wide, 0, 0), "windows")
    yield Object(Cuboid((wide + 0.22, 0.2, 0.06)), TRIM, place @ Pose.at(0, 0, -high - 0.14), "windows")
    if style.shutters is not None:
        for side in (-1, 1):
            leaf = place @ Pose.at(side * (1.45 * wide + 0.14), 0, 0)
            yield Object(Cuboid((0.42 * wide, 0.07, high + 0.05)), style.shutters, leaf, "windows")


def shop(place: Pose, random: np.random.Generator) -> Iterator[Object]:
    """A large pane under an awning or a sign."""
    colour, other = (PAINTS[i] for i in random.integers(len(PAINTS), size=2))
    yield Object(Cuboid((1.0, 0.05, 1.05)), PANES[0], place @ Pose.at(0, 0, 1.75), "shops")
    yield Object(Cuboid((1.08, 0.04, 1.13)), TRIM, place @ Pose.at(0, 0, 1.75), "shops")
    if random.uniform() < 0.5:
        cloth = Material(Stripes(colour, (0.92, 0.90, 0.85), period=0.5, share=0.5))
        slope = place @ Pose.at(0, -0.5, 2.95, tilt=25) @ Pose.about((0, 1, 0), 90)
        yield Object(Cuboid((0.03, 0.55, 1.1)), cloth, slope, "shops")
    else:
        sign = Material(Checker(colour, other, size=0.45, shift=random.uniform(0, 0.4)))
        yield Object(Cuboid((1.05, 0.09, 0.26)), sign, place @ Pose.at(0, 0, 3.2), "shops")
