"""A stage: a world, and the cameras around it."""

from __future__ import annotations

from dataclasses import dataclass

from ...camera import Camera
from .world import Vector, World


@dataclass(frozen=True)
class Stage:
    """A procedural scene ready to be photographed.

    cameras: by split
    bounds:  the box of interest, lowest and highest corner
    reach:   half-size of the cube around the origin that holds everything worth modelling
    near:    distance from every camera within which there is nothing
    """

    world: World
    cameras: dict[str, Camera]
    bounds: tuple[Vector, Vector]
    reach: float
    near: float
