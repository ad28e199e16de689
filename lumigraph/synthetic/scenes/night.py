"""The study at night: two lamps and the moon through the window, photographed raw by a hand-held camera at three
shutter times, mostly dark. The noise-free radiance is known."""

from dataclasses import replace

import numpy as np
import torch

from ..cameras import look_at, pinhole
from ..sensor import Sensor
from ..stage import SyntheticStage
from ..world import Lamp, Sky, World
from . import room

FIELD_OF_VIEW = 68.0  # degrees


def world() -> World:
    lights = (
        Lamp((-0.70, 0.30, 0.24), radius=0.03, power=0.25, colour=(1.0, 0.80, 0.56)),  # above the shade
        Lamp((0.10, 0.30, -0.10), radius=0.02, power=0.012, colour=(1.0, 0.62, 0.34)),  # a candle before the sofa
        Lamp((0.80, 0.08, 0.10), radius=0.05, power=0.05, colour=(0.62, 0.76, 1.0)),  # the moon, through the window
    )
    sky = Sky((0.60, 0.70, 0.95), (0.70, 0.70, 0.80), (0.55, 0.45, 0.38), light=0.03, visible=True, reach=0.15)
    return replace(room.world(), lights=lights, sky=sky)


def sample_poses(count: int, random: np.random.Generator) -> np.ndarray:
    """Hand-held poses at one side of the room, looking at the other."""
    poses = []
    for _ in range(count):
        eye = (random.uniform(-0.40, 0.25), random.uniform(-0.42, -0.15), random.uniform(-0.22, 0.14))
        poses.append(look_at(eye, (random.uniform(-0.35, 0.15), 0.75, random.uniform(-0.22, 0.0))))
    return np.stack(poses)


def stage(size: int = 200, views: int = 100, seed: int = 0) -> SyntheticStage:
    """`views` training photographs, and a fifth as many held out."""
    random = np.random.default_rng(seed)
    held_out = max(views // 5, 1)
    cameras = pinhole(sample_poses(views + held_out, random), size, FIELD_OF_VIEW)
    cameras = replace(cameras, image_index=torch.arange(len(cameras)))
    return SyntheticStage(
        world(),
        {"train": cameras[:views], "test": cameras[views:]},
        ((-1.0, -0.8, -0.56), (1.0, 0.8, 0.5)),
        reach=1.0,
        near=0.1,
        sensor=Sensor(sensitivity=0.02),
    )
