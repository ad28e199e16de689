"""Balls of several colours, each a scene of its own: something small to learn a collection from."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import tiny

from lumigraph.datasets.collection import Collection
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.scene import Scene

TINTS = {  # the first one by name is for testing
    "amber": (1.0, 0.7, 0.1),
    "blue": (0.2, 0.4, 1.0),
    "green": (0.2, 0.9, 0.3),
    "white": (1.0, 1.0, 1.0),
}


@cache
def tinted(name: str) -> Scene:
    """The tiny scene seen through coloured glass."""
    ball = tiny.scene()
    tint = np.array([*TINTS[name], 1.0])
    pictures = [(ball.images[i].numpy() * tint).round().astype(np.uint8) for i in range(len(ball))]
    return replace(ball, images=ImageStore.from_arrays(pictures), source=name)


def collection() -> Collection:
    """What a method that learns from a Collection is tested on: three balls to learn from, one held out."""
    return Collection.of({name: (lambda name=name: tinted(name)) for name in TINTS}, "in memory")
