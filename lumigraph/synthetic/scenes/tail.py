"""A tail: a chain of 2 to 60 bones in a row that winds from time 0 to time 1; see `characters`."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch

from ...datasets.skeleton import ROOT, BonePose, Skeleton, posed
from ...files.ranges import between
from ..characters import FILL, KEY, SKY, CharacterOptions, Joints, SolidCharacter, photographed
from ..shapes import SoftCapsule
from ..stage import SyntheticStage
from ..textures import Checker, Mottle, Stripes
from ..world import Material, Object, Pose, World, nested, rotation_about

HALF_LENGTH, THICK = 0.75, 0.16  # of the tail at rest, which lies along x, and its radius at the root; scene units
BEND, WAVES = 100.0, 1.5  # degrees between root and tip at most; waves along the tail
PAINTS = (
    Mottle((0.80, 0.52, 0.25), (0.45, 0.24, 0.12), size=0.15, contrast=1.5),
    Stripes((0.20, 0.34, 0.55), (0.90, 0.86, 0.70), period=0.06),
    Checker((0.25, 0.42, 0.24), (0.78, 0.80, 0.52), size=0.06),
)


@dataclass(frozen=True)
class Options(CharacterOptions):
    """Options of every character; joints: bones of the tail; clips: times that it winds in the capture"""

    joints: Annotated[int, between(2, 60)] = 12
    clips: Annotated[int, between(1, 100)] = 3


@dataclass(frozen=True)
class Tail(SolidCharacter):
    """The tail, a `characters.Character`."""

    joints: int
    clips: int

    def chain(self, turns: np.ndarray) -> Joints:
        """Joints after rotations by degrees (joint, 2) about y, then z."""
        local = np.zeros((self.joints, 3, 4))
        local[:, 0, 3] = 2 * HALF_LENGTH / self.joints
        local[0, 0, 3] = -HALF_LENGTH
        local[:, :, :3] = [rotation_about((0, 0, 1), z) @ rotation_about((0, 1, 0), y) for y, z in turns]
        return posed(range(ROOT, self.joints - 1), torch.from_numpy(local)).numpy()

    @property
    def skeleton(self) -> Skeleton:
        pose = BonePose.of(torch.from_numpy(self.chain(np.zeros((self.joints, 2)))))
        return Skeleton(
            tuple(f"bone {i}" for i in range(self.joints)), tuple(range(ROOT, self.joints - 1)), pose, (0.0,), (pose,)
        )

    def pose(self, share: float) -> Joints:
        """Joints at a time from 0 to 1."""
        phase = 2 * math.pi * (self.clips * share - WAVES * np.arange(self.joints) / self.joints)
        return self.chain(BEND / self.joints * np.stack([np.sin(phase), np.cos(2 * phase)], 1))

    def world(self, pose: Joints) -> World:
        """The tail in a pose, with light."""
        half, along = HALF_LENGTH / self.joints, Pose.at(HALF_LENGTH / self.joints, 0, 0) @ Pose.about((0, 1, 0), 90)
        objects = tuple(
            Object(
                SoftCapsule(THICK * (1 - 0.7 * i / self.joints), half),
                Material(PAINTS[3 * i // self.joints], gloss=0.2, roughness=0.5),
                Pose(tuple(pose[i, :, 3].tolist()), nested(pose[i, :, :3])) @ along,
                f"bone {i}",
            )
            for i in range(self.joints)
        )
        return World(objects, (KEY, FILL), SKY)


def stage(
    size: int = 200,
    views: int = 100,
    seed: int = 0,
    rig: int = 0,
    jitter_bones: int = 0,
    joints: int = 12,
    clips: int = 3,
) -> SyntheticStage:
    return photographed(Tail(joints, clips), size, views, seed, rig, jitter_bones)
