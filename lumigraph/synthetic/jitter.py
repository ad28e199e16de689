"""Poses that are a little off, as structure from motion finds them on a bad day, to see who finds them again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ..camera import Camera
from .stage import SyntheticStage
from .world import rotation_about


def jittered(stage: SyntheticStage, amount: float, seed: int) -> dict[str, Camera]:
    """The stage's cameras, those to learn from each turned by `amount` degrees about an axis of its own and moved by
    `amount` percent of the longest side of the box of interest, or of `Stage.error`, any way. Held-out ones stay where
    they are."""
    random = np.random.default_rng([seed, 0x9E3779B9])
    low, high = (np.array(corner) for corner in stage.bounds)
    shift = amount / 100 * (stage.error or float((high - low).max()))
    cameras = stage.cameras["train"]
    pose = cameras.pose.double().numpy().copy()
    for one in pose:
        axis, way = random.normal(size=(2, 3))
        one[:, :3] = rotation_about(tuple(axis), amount) @ one[:, :3]
        one[:, 3] += shift * way / np.linalg.norm(way)
    return stage.cameras | {"train": replace(cameras, pose=torch.from_numpy(pose).to(cameras.pose))}
