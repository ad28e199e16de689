"""A walker: a figure of soft limbs on 16 bones, which walks on the spot from time 0 to time 1; see `characters`."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from ...datasets.skeleton import ROOT, BonePose, Skeleton, posed
from ..characters import CharacterOptions, Joints, SolidCharacter, moved_shapes, photographed, turned_along
from ..shapes import Ball, Cuboid, SoftCapsule, SolidShape
from ..stage import SyntheticStage
from ..textures import Checker, Mottle, Plain, Stripes, Texture
from ..world import Pose, World, rotation_about

Options = CharacterOptions
STRIDES = 5  # walking cycles in a capture
SKIN, HAIR, EYE, LIP = (0.86, 0.64, 0.52), (0.25, 0.15, 0.10), (0.10, 0.12, 0.20), (0.70, 0.22, 0.24)
SHIRT, STRIPE = (0.16, 0.34, 0.66), (0.93, 0.90, 0.82)
TROUSERS, SEAM = (0.24, 0.25, 0.30), (0.52, 0.50, 0.46)
SHOE, SOLE = (0.72, 0.20, 0.15), (0.95, 0.93, 0.88)
# Joints at rest: parent, and position; the figure faces -y, its left is at +x, its arms are lowered by half.
JOINTS: dict[str, tuple[str, tuple[float, float, float]]] = {
    "hips": ("", (0.0, 0.0, 0.05)),
    "spine": ("hips", (0.0, 0.0, 0.20)),
    "neck": ("spine", (0.0, 0.0, 0.50)),
    "head": ("neck", (0.0, 0.0, 0.58)),
    **{
        f"{side} {name}": (f"{side} {parent}" if parent in ("upper arm", "forearm", "thigh", "shin") else parent, place)
        for side, x in (("left", 1), ("right", -1))
        for name, parent, place in (
            ("upper arm", "spine", (0.17 * x, 0.0, 0.44)),
            ("forearm", "upper arm", (0.35 * x, 0.0, 0.26)),
            ("hand", "forearm", (0.51 * x, 0.0, 0.10)),
            ("thigh", "hips", (0.09 * x, 0.0, 0.03)),
            ("shin", "thigh", (0.10 * x, 0.0, -0.37)),
            ("foot", "shin", (0.10 * x, 0.01, -0.74)),
        )
    },
}
NAMES = tuple(JOINTS)
PARENTS = tuple(NAMES.index(parent) if parent else ROOT for parent, _ in JOINTS.values())
PLACES = np.array([place for _, place in JOINTS.values()])


def rest() -> Joints:
    """Rest pose of the joints, axes along the world's."""
    return np.concatenate([np.broadcast_to(np.eye(3), (len(NAMES), 3, 3)), PLACES[:, :, None]], -1)


def angles(share: float) -> dict[str, tuple[float, float, float]]:
    """Joint angles about x, y and z in degrees at a time from 0 to 1: swing, sideways, twist."""
    phase = 2 * math.pi * STRIDES * share
    found = {
        "hips": (2.0, 3.0 * math.sin(phase), 8.0 * math.sin(phase)),
        "spine": (3.0, -4.0 * math.sin(phase), -16.0 * math.sin(phase)),
        "head": (4.0 * math.sin(2 * phase), 0.0, 10.0 * math.sin(phase)),
    }
    for side, way in (("left", 1.0), ("right", -1.0)):
        swing = way * math.sin(phase)
        lift = max(0.0, way * math.cos(phase))
        found[f"{side} upper arm"] = (30.0 * swing, 32.0 * way, 0.0)
        found[f"{side} forearm"] = (-22.0 - 18.0 * max(0.0, -swing), 0.0, 0.0)
        found[f"{side} hand"] = (-8.0 * swing, 0.0, 0.0)
        found[f"{side} thigh"] = (-28.0 * swing - 8.0 * lift, 0.0, 0.0)
        found[f"{side} shin"] = (10.0 + 42.0 * lift, 0.0, 0.0)
        found[f"{side} foot"] = (12.0 * swing, 0.0, 0.0)
    return found


def joints(turns: dict[str, tuple[float, float, float]], lift: float = 0.0) -> Joints:
    """Joints after rotations by degrees about x, then y, then z; the hips are lifted, scene units."""
    local = rest()
    local[:, :, 3] -= np.where(np.array(PARENTS)[:, None] < 0, 0, PLACES[np.maximum(PARENTS, 0)])
    local[0, 2, 3] += lift
    for name, (x, y, z) in turns.items():
        turn = rotation_about((0, 0, 1), z) @ rotation_about((0, 1, 0), y) @ rotation_about((1, 0, 0), x)
        local[NAMES.index(name), :, :3] = turn
    return posed(PARENTS, torch.from_numpy(local)).numpy()


def limb(start: str, end: str, radius: float, texture: Texture) -> Iterator[tuple[str, SolidShape, Texture, Pose]]:
    """A capsule from one joint to the next, moved by the first."""
    a, b = (np.array(JOINTS[name][1]) for name in (start, end))
    along = (b - a) / np.linalg.norm(b - a)
    shape = SoftCapsule(radius, 0.5 * float(np.linalg.norm(b - a)))
    yield start, shape, texture, Pose(tuple(0.5 * (a + b)), turned_along(along))


def parts() -> Iterator[tuple[str, SolidShape, Texture, Pose]]:
    """Shapes of the figure at rest, with each one's joint."""
    skin, shirt = Mottle(SKIN, (0.78, 0.52, 0.42), size=0.3, contrast=1.5), Stripes(SHIRT, STRIPE, period=0.11)
    cloth = Checker(TROUSERS, SEAM, size=0.09)
    yield "hips", SoftCapsule(0.115, 0.05), cloth, Pose.at(0, 0, 0.05) @ Pose.about((0, 1, 0), 90)
    yield "spine", SoftCapsule(0.125, 0.09), shirt, Pose.at(0, 0, 0.26)
    yield "spine", SoftCapsule(0.10, 0.085), shirt, Pose.at(0, 0, 0.40) @ Pose.about((0, 1, 0), 90)
    yield "neck", SoftCapsule(0.05, 0.05), skin, Pose.at(0, 0, 0.54)
    yield "head", Ball(0.125), skin, Pose.at(0, -0.01, 0.69)
    yield "head", Ball(0.128), Plain(HAIR), Pose.at(0, 0.022, 0.715)
    yield "head", Ball(0.028), skin, Pose.at(0, -0.135, 0.68)
    yield "head", SoftCapsule(0.014, 0.03), Plain(LIP), Pose.at(0, -0.118, 0.63) @ Pose.about((0, 1, 0), 90)
    for side, x in (("left", 1.0), ("right", -1.0)):
        yield "head", Ball(0.024), Plain(EYE), Pose.at(0.048 * x, -0.112, 0.715)
        yield from limb(f"{side} upper arm", f"{side} forearm", 0.055, shirt)
        yield from limb(f"{side} forearm", f"{side} hand", 0.042, skin)
        glove = Plain((0.92, 0.74, 0.18)) if side == "left" else Plain((0.20, 0.55, 0.32))
        palm = Pose.at(0.535 * x, 0, 0.075) @ Pose.about((0, 1, 0), 135 * x)
        yield f"{side} hand", SoftCapsule(0.045, 0.03), glove, palm
        yield from limb(f"{side} thigh", f"{side} shin", 0.078, cloth)
        yield from limb(f"{side} shin", f"{side} foot", 0.058, cloth)
        shoe = Stripes(SHOE, SOLE, period=0.06)
        yield f"{side} foot", Cuboid((0.052, 0.12, 0.042), 0.035), shoe, Pose.at(0.10 * x, -0.055, -0.775)


@dataclass(frozen=True)
class Walker(SolidCharacter):
    """The figure, a `characters.Character`."""

    @property
    def skeleton(self) -> Skeleton:
        pose = BonePose.of(torch.from_numpy(rest()))
        return Skeleton(NAMES, PARENTS, pose, (0.0,), (pose,))

    def pose(self, share: float) -> Joints:
        """Joints at a time from 0 to 1."""
        return joints(angles(share), lift=0.012 * math.cos(4 * math.pi * STRIDES * share))

    def world(self, pose: Joints) -> World:
        """The figure in a pose, with light."""
        return moved_shapes(parts(), NAMES, rest(), pose, (0.2, 0.5))


def stage(size: int = 200, views: int = 100, seed: int = 0, rig: int = 0, jitter_bones: int = 0) -> SyntheticStage:
    return photographed(Walker(), size, views, seed, rig, jitter_bones)
