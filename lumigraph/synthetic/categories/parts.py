"""Parts of several categories: random colours and materials."""

import colorsys

import numpy as np

from ..textures import Checker, Colour, Marble, Plain, Stripes, Texture, Wood
from ..world import Material

MAPLE, WALNUT = ((0.86, 0.70, 0.50), (0.70, 0.50, 0.31)), ((0.47, 0.30, 0.19), (0.26, 0.15, 0.09))
BRASS = Material(Plain((0.90, 0.72, 0.40)), roughness=0.35, metal=1.0)
STEEL = Material(Plain((0.72, 0.73, 0.75)), roughness=0.4, metal=1.0)
RUBBER = Material(Plain((0.10, 0.10, 0.11)), gloss=0.3, roughness=0.6)
GLASS = Material(Plain((0.16, 0.20, 0.26)), gloss=1.0, roughness=0.25)


def colour(random: np.random.Generator, vivid: tuple[float, float] = (0.35, 0.85)) -> Colour:
    """Random hue. vivid: least and most saturation"""
    return colorsys.hsv_to_rgb(random.uniform(), random.uniform(*vivid), random.uniform(0.45, 0.95))


def paint(colour: Colour) -> Material:
    return Material(Plain(colour), gloss=0.8, roughness=0.35)


def timber(random: np.random.Generator) -> Material:
    light, dark = MAPLE if random.uniform() < 0.5 else WALNUT
    return Material(Wood(light, dark, ring=0.07, seed=float(random.uniform(0, 50))), gloss=0.5, roughness=0.5)


def finish(random: np.random.Generator) -> Material:
    """Random material: mostly paint, sometimes a pattern, marble or wood."""
    kind, a, b = random.uniform(), colour(random), colour(random, (0.0, 0.25))
    if kind < 0.55:
        return paint(a)
    if kind < 0.70:
        return timber(random)
    patterns: tuple[Texture, ...] = (
        Stripes(a, b, period=random.uniform(0.10, 0.2)),
        Checker(a, b, size=random.uniform(0.10, 0.2)),
        Marble(b, a, vein=random.uniform(0.3, 0.6), seed=float(random.uniform(0, 50))),
    )
    return Material(patterns[random.integers(len(patterns))], gloss=0.6, roughness=0.4)
