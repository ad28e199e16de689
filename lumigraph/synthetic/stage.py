"""A stage: a world, and the cameras around it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..camera import Camera
from .sensor import Sensor
from .world import Rotation, Vector, World


@dataclass(frozen=True)
class SyntheticStage:
    """A procedural scene ready to be photographed.

    world:   at the first moment, where things move
    cameras: by split; their `time` says when each photograph is taken, where things move
    bounds:  the box of interest, lowest and highest corner
    reach:   half-size of the cube around the origin that holds everything worth modelling
    near:    distance from every camera within which there is nothing
    moving:  the world at a moment; None where nothing moves
    differing: the world when a photograph was taken, by its `image_index`, where light or people differ from one to the
             next; None where they do not
    lasting: the same without whatever only passed by
    turn:    rotation from the frame in which an object of a category stands upright and faces the way that all of them
             do, to the world; None where there is no such frame
    sensor:  what takes its photographs raw, which the cameras' `image_index` counts; None where they are pictures alone
    facts:   what a photograph says of itself, by its `image_index`; see `Scene.about`
    called:  a name for all that the world of a photograph depends on, by its `image_index`, under which its picture is
             kept; None where pictures are not kept
    error:   the length of which errors of poses are so many percent; None for the longest side of the bounds
    """

    world: World
    cameras: dict[str, Camera]
    bounds: tuple[Vector, Vector]
    reach: float
    near: float
    moving: Callable[[float], World] | None = None
    differing: Callable[[int], World] | None = None
    lasting: Callable[[int], World] | None = None
    turn: Rotation | None = None
    sensor: Sensor | None = None
    facts: Callable[[int], dict[str, Any]] | None = None
    called: Callable[[int], str] | None = None
    error: float | None = None

    def world_of(self, camera: Camera) -> World:
        """The world at the moment when a camera (a batch of one) takes its photograph."""
        if self.differing is not None and camera.image_index is not None:
            return self.differing(int(camera.image_index))
        return self.world if self.moving is None or camera.time is None else self.moving(float(camera.time))
