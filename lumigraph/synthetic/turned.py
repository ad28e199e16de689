"""Objects in poses that nobody chose: each turned by a random rotation, to see who finds what all of a kind share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .cameras import dome, pinhole, spiral
from .categories import FIELD_OF_VIEW
from .stage import SyntheticStage
from .world import Pose, nested

BALL_RADIUS = 1.2  # contains every member in every rotation
CAMERA_DISTANCE = 4.1  # from the centre, at which that ball just fits into the picture
MAX_ELEVATION = 60.0  # degrees of the cameras above and below the horizon: no side is the lower one


def turned(stage: SyntheticStage, size: int, seed: tuple[int, int]) -> SyntheticStage:
    """The stage with its objects turned about the origin by a random rotation; light and horizon stay. Cameras stand
    all around. `Stage.turn` is the rotation since the object stood upright, where that is known.

    size: of the square pictures, pixels
    """
    random = np.random.default_rng((*seed, 0x7EEDED))
    motion = Pose(rotation=nested(any_rotation(random)))
    objects = tuple(replace(thing, pose=motion @ thing.pose) for thing in stage.world.objects)
    views, held_out = (len(stage.cameras[split]) for split in ("train", "test"))
    cameras = {
        "train": pinhole(dome(views, CAMERA_DISTANCE, random, -MAX_ELEVATION, MAX_ELEVATION), size, FIELD_OF_VIEW),
        "test": pinhole(spiral(held_out, CAMERA_DISTANCE, random, -MAX_ELEVATION, MAX_ELEVATION), size, FIELD_OF_VIEW),
    }
    bounds = (-BALL_RADIUS, -BALL_RADIUS, -BALL_RADIUS), (BALL_RADIUS, BALL_RADIUS, BALL_RADIUS)
    known = Pose() if stage.turn is None else Pose(rotation=stage.turn)
    world, turn = replace(stage.world, objects=objects), (motion @ known).rotation
    return replace(stage, world=world, cameras=cameras, bounds=bounds, reach=BALL_RADIUS, turn=turn)


def any_rotation(random: np.random.Generator) -> np.ndarray:
    """A rotation matrix, all equally likely: the first factor of a Gaussian matrix (Stewart 1980)."""
    q, r = np.linalg.qr(random.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))
