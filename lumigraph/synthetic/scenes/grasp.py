"""A hand that grasps a can and lets it go, from time 0 to time 1: 16 bones of the hand and one of the can."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from ...datasets.skeleton import ROOT, BonePose, Skeleton, posed
from ..characters import CharacterOptions, Joints, SolidCharacter, moved_shapes, photographed, turned_along
from ..shapes import Cuboid, Cylinder, SoftCapsule, SolidShape
from ..stage import SyntheticStage
from ..textures import Mottle, Plain, Sectors, Texture
from ..world import Pose, World, rotation_about

Options = CharacterOptions
SKIN, BLUSH, NAIL = (0.86, 0.64, 0.52), (0.74, 0.46, 0.38), (0.95, 0.78, 0.74)
RED, CREAM = (0.78, 0.16, 0.14), (0.95, 0.91, 0.82)
CAN = "can"
CAN_RADIUS, CAN_HALF, CAN_PLACE = 0.24, 0.42, (0.0, -0.33, 0.32)
# Fingers: place of the first joint, lengths of three bones, radius, curl of each joint in the grasp, degrees.
PALM = (0.24, 0.07, 0.22)  # half-sizes; the palm faces -y, its fingers point up
FINGERS = {
    "index": ((-0.18, 0.0, 0.22), (0.24, 0.17, 0.13), 0.058),
    "middle": ((-0.06, 0.0, 0.24), (0.27, 0.19, 0.14), 0.060),
    "ring": ((0.06, 0.0, 0.23), (0.25, 0.17, 0.13), 0.057),
    "little": ((0.17, 0.0, 0.19), (0.19, 0.13, 0.11), 0.050),
    "thumb": ((-0.24, -0.03, -0.08), (0.22, 0.18, 0.14), 0.066),
}
CURL = (58.0, 52.0, 40.0)  # degrees of a finger's joints in the grasp
THUMB_CURL = (30.0, 42.0, 36.0)
REST_AWAY = 0.5  # of the hand at rest from where it grasps, so that each body is nearest to its own bones


def bones() -> tuple[tuple[str, ...], tuple[int, ...], Joints]:
    """Names, parents and rest pose of the joints, the hand open; axes along the world's."""
    names, parents, places = ["wrist"], [ROOT], [(0.0, REST_AWAY, -0.26)]
    for finger, (start, lengths, _) in FINGERS.items():
        along, place, parent = direction(finger), np.array(start) + (0.0, REST_AWAY, 0.0), 0
        for number, length in enumerate(lengths):
            names.append(f"{finger} {number + 1}")
            parents.append(parent)
            places.append(tuple(place))
            parent, place = len(names) - 1, place + length * along
    names, parents, places = [*names, CAN], [*parents, ROOT], [*places, CAN_PLACE]
    turns = np.broadcast_to(np.eye(3), (len(names), 3, 3))
    return tuple(names), tuple(parents), np.concatenate([turns, np.array(places)[:, :, None]], -1)


def direction(finger: str) -> np.ndarray:
    """Direction of an open finger at rest."""
    along = np.array([-0.75, -0.25, 0.61]) if finger == "thumb" else np.array([0.0, 0.0, 1.0])
    return along / np.linalg.norm(along)


@dataclass(frozen=True)
class Grasp(SolidCharacter):
    """Hand and can, a `characters.Character`."""

    @property
    def skeleton(self) -> Skeleton:
        names, parents, joints = bones()
        pose = BonePose.of(torch.from_numpy(joints))
        return Skeleton(names, parents, pose, (0.0,), (pose,))

    def pose(self, share: float) -> Joints:
        """Joints at a time from 0 to 1: open, closed around the can, open."""
        names, parents, joints = bones()
        closed = 0.5 - 0.5 * math.cos(2 * math.pi * share)
        local = joints.copy()
        for number, parent in enumerate(parents):
            if parent >= 0:
                local[number, :, 3] -= joints[parent, :, 3]
        for number, name in enumerate(names):
            finger, _, joint = name.partition(" ")
            if finger == "thumb":
                turn = rotation_about((0.55, -0.25, 0.8), closed * THUMB_CURL[int(joint) - 1])
                local[number, :, :3] = turn
            elif finger in FINGERS:
                local[number, :, :3] = rotation_about((1, 0, 0), closed * CURL[int(joint) - 1])
        away = 0.25 * (1 - closed)
        local[0, 1, 3] += away - REST_AWAY  # the hand comes from behind
        return posed(parents, torch.from_numpy(local)).numpy()

    def parts(self) -> Iterator[tuple[str, SolidShape, Texture, Pose]]:
        """Shapes at rest, with each one's bone."""
        names, _, joints = bones()
        skin = Mottle(SKIN, BLUSH, size=0.25, contrast=2.0)
        yield "wrist", Cuboid(PALM, 0.065), skin, Pose.at(0, REST_AWAY, 0)
        for finger, (_, lengths, radius) in FINGERS.items():
            along = direction(finger)
            turn = turned_along(along)
            for number, length in enumerate(lengths):
                name = f"{finger} {number + 1}"
                middle = joints[names.index(name), :, 3] + 0.5 * length * along
                paint = skin if number < 2 else Plain(NAIL)
                yield name, SoftCapsule(radius, 0.5 * length), paint, Pose(tuple(middle.tolist()), turn)
        yield CAN, Cylinder(CAN_RADIUS, CAN_HALF, 0.03), Sectors(RED, CREAM, count=8), Pose.at(*CAN_PLACE)

    def world(self, pose: Joints) -> World:
        """Hand and can in a pose, with light."""
        names, _, home = bones()
        return moved_shapes(self.parts(), names, home, pose, (0.3, 0.4))


def stage(size: int = 200, views: int = 100, seed: int = 0, rig: int = 0, jitter_bones: int = 0) -> SyntheticStage:
    return photographed(Grasp(), size, views, seed, rig, jitter_bones)
