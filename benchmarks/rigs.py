"""Rigs of any number of joints for `articulated.py`: five chains of soft limbs about a root, of seeded motion.

The motion of a clip has frequencies of 0.3 to 1.2 Hz, so a long clip has more of it between two photographs. A sword
is rigid on a bone of its own, a tree beside the body's, which follows a hand and turns about it. A coat is of six
panels around the hips without bones of their own, which flare out as the first limb turns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch

from lumigraph.datasets.skeleton import ROOT, BonePose, Skeleton, posed
from lumigraph.synthetic.characters import FILL, KEY, SKY, Joints
from lumigraph.synthetic.shapes import Ball, Cuboid, SoftCapsule
from lumigraph.synthetic.textures import Checker, Mottle, Plain, Stripes
from lumigraph.synthetic.world import Material, Object, Pose, World, nested, rotation_about

CHAINS = np.array([[-0.9, 0, 0.45], [0.9, 0, 0.45], [0, 0, 1], [-0.35, 0, -1], [0.35, 0, -1]])
HUES = np.array([[0.8, 0.25, 0.2], [0.2, 0.6, 0.3], [0.85, 0.7, 0.2], [0.5, 0.3, 0.65], [0.25, 0.55, 0.7]])
REACH = 0.62  # length of a chain, scene units
MAX_ANGLE = 55.0  # degrees of the sum of a chain's joints, on each of two waves
FREQUENCIES = (0.3, 1.2)  # Hz
SWORD, PANELS = 0.6, 6  # length, scene units; panels of a coat


@dataclass(frozen=True)
class Rig:
    """A body of so many joints whose clip lasts so many seconds, a `characters.Character`."""

    joints: int
    seconds: float = 3.0
    loose: Literal["", "sword", "coat", "sword+coat"] = ""

    @cached_property
    def chains(self) -> list[list[int]]:
        """Numbers of the joints of each chain, from the root outwards."""
        count = min(len(CHAINS), max(self.joints - 1, 1))
        return [list(range(1 + k, self.joints, count)) for k in range(count)]

    @cached_property
    def rest(self) -> tuple[tuple[int, ...], Joints]:
        """Parents and joints at rest, axes along the world's; a sword's is the last."""
        parents, places = [ROOT] * self.joints, np.zeros((self.joints, 3))
        for along, chain in zip(CHAINS, self.chains, strict=False):
            along = along / np.linalg.norm(along)
            for number, joint in enumerate(chain):
                parents[joint] = 0 if number == 0 else chain[number - 1]
                places[joint] = along * (0.12 + (REACH - 0.12) * number / len(chain))
        if "sword" in self.loose:
            parents, places = [*parents, ROOT], np.concatenate([places, [self.end(0) + (0, -0.08, 0)]])
        turns = np.broadcast_to(np.eye(3), (len(parents), 3, 3))
        return tuple(parents), np.concatenate([turns, places[:, :, None]], -1)

    def end(self, chain: int) -> np.ndarray:
        """Place at rest at which a chain ends."""
        return REACH * CHAINS[chain] / np.linalg.norm(CHAINS[chain])

    @property
    def skeleton(self) -> Skeleton:
        parents, joints = self.rest
        pose = BonePose.of(torch.from_numpy(joints))
        return Skeleton(tuple(f"joint {i}" for i in range(len(parents))), parents, pose, (0.0,), (pose,))

    @cached_property
    def waves(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Axis, frequencies in Hz and phases of each joint's two waves."""
        random = np.random.default_rng((self.joints, 0x516))
        axes = random.normal(size=(self.joints, 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        return axes, random.uniform(*FREQUENCIES, (self.joints, 2)), random.uniform(0, 2 * math.pi, (self.joints, 2))

    def pose(self, share: float) -> Joints:
        parents, local = self.rest[0], self.rest[1].copy()
        axes, frequencies, phases = self.waves
        for joint, parent in enumerate(parents):
            if parent >= 0:
                local[joint, :, 3] -= self.rest[1][parent, :, 3]
        for joint in range(self.joints):
            waves = np.sin(2 * math.pi * frequencies[joint] * self.seconds * share + phases[joint]).sum()
            links = 3.0 if joint == 0 else math.sqrt(len(self.chains[(joint - 1) % len(self.chains)]))
            local[joint, :, :3] = rotation_about(tuple(axes[joint]), 0.5 * MAX_ANGLE / links * waves)
        if "sword" in self.loose:
            body = posed(parents[:-1], torch.from_numpy(local[:-1])).numpy()
            hand = body[self.chains[0][-1]]
            local[-1, :, 3] = hand[:, :3] @ (self.end(0) - self.rest[1][self.chains[0][-1], :, 3]) + hand[:, 3]
            local[-1, :, :3] = hand[:, :3] @ rotation_about(
                (1, 0, 0), 60 * math.sin(2 * math.pi * self.seconds * share)
            )
        return posed(parents, torch.from_numpy(local)).numpy()

    def world(self, pose: Joints) -> World:
        parents, home = self.rest
        shift = pose[:, :, 3] - (pose[:, :, :3] @ home[:, :, 3:])[:, :, 0]
        moves = [Pose(tuple(shift[i].tolist()), nested(pose[i, :, :3])) for i in range(len(parents))]
        objects = [(0, Ball(0.13), Checker((0.16, 0.34, 0.66), (0.93, 0.90, 0.82), size=0.08), Pose())]
        for k, chain in enumerate(self.chains):
            light = HUES[k] + 0.6 * (1 - HUES[k])
            ends = [home[joint, :, 3] for joint in chain] + [self.end(k)]
            for number, joint in enumerate(chain):
                hue, pale = tuple(HUES[k].tolist()), tuple(light.tolist())
                paint = Stripes(hue, pale, 0.07) if number % 2 else Mottle(hue, pale, 0.2)
                objects.append((joint, *between(ends[number], ends[number + 1], 0.062, paint)))
        if "sword" in self.loose:
            hilt = home[-1, :, 3]
            objects.append((len(parents) - 1, *between(hilt, hilt + (0, 0, SWORD), 0.022, Plain((0.75, 0.77, 0.8)))))
        if "coat" in self.loose:
            cosine = 0.5 * float(np.trace(pose[1, :, :3] @ pose[0, :, :3].T)) - 0.5
            flare = 20 + 60 * (1 - cosine)
            for k in range(PANELS):
                hang = Pose.about((0, 0, 1), 360 / PANELS * k) @ Pose.at(0.1, 0, -0.08) @ Pose.about((0, 1, 0), -flare)
                cloth = Checker((0.55, 0.2, 0.25), (0.8, 0.6, 0.5), size=0.07)
                objects.append((0, Cuboid((0.008, 0.085, 0.15), 0.006), cloth, hang @ Pose.at(0, 0, -0.15)))
        shown = tuple(
            Object(shape, Material(paint, gloss=0.2, roughness=0.5), moves[i] @ at, "body")
            for i, shape, paint, at in objects
        )
        return World(shown, (KEY, FILL), SKY)

    def extent(self, pose: Joints) -> tuple[np.ndarray, np.ndarray]:
        return self.world(pose).bounds()


def between(a: np.ndarray, b: np.ndarray, radius: float, paint: object) -> tuple:
    """A capsule from one place to another."""
    along = (b - a) / np.linalg.norm(b - a)
    side = np.cross([0.0, 1.0, 0.0], along)
    side /= np.linalg.norm(side)
    turn = np.stack([side, np.cross(along, side), along], 1)
    return SoftCapsule(radius, 0.5 * float(np.linalg.norm(b - a))), paint, Pose(tuple(0.5 * (a + b)), nested(turn))
