"""Skeletons: bones of one character, its rest pose, and its poses over time.

A bone is named after the joint that it turns about. A pose has the position and the rotation of every joint in one
frame, so that a point x of the body at rest, fully weighted to bone k, goes to G_k G_k(rest)^-1 x.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..errors import LumigraphError
from ..files.ranges import Coordinate, Name, Point, Row, between
from ..geometry import Similarity, multiply, to_matrix, to_quaternion

ROOT = -1  # number in place of a parent
Bone = Annotated[int, between(ROOT, 4095)]


@dataclass(frozen=True)
class BonePose:
    """Joints at one time, in one frame.

    positions: of the joints
    rotations: from the axes of each joint to the frame's, quaternions (w, x, y, z)
    """

    positions: tuple[Point, ...]
    rotations: tuple[Row, ...]

    @staticmethod
    def of(matrices: Float[Tensor, "bone 3 4"]) -> BonePose:
        """Pose of joint-to-frame matrices."""
        turns = to_quaternion(matrices[:, :, :3])
        turns = torch.where(turns[:, :1] < 0, -turns, turns)
        return BonePose(tuple(map(tuple, matrices[:, :, 3].tolist())), tuple(map(tuple, turns.tolist())))

    @property
    def matrices(self) -> Float[Tensor, "bone 3 4"]:
        """Joint-to-frame matrices, in double precision."""
        positions, rotations = (torch.tensor(x, dtype=torch.float64) for x in (self.positions, self.rotations))
        return torch.cat([to_matrix(rotations), positions[:, :, None]], -1)


@dataclass(frozen=True)
class Skeleton:
    """Bones of one character and its poses over time.

    names:   of the bones, unique
    parents: number of each bone's parent, which comes before it; -1 for a root
    rest:    rest pose of the canonical body (the bind pose)
    times:   of the poses, in order, in the unit of the photographs' times; a single one is constant
    poses:   at these times, with interpolation between them
    """

    names: tuple[Name, ...]
    parents: tuple[Bone, ...]
    rest: BonePose
    times: tuple[Coordinate, ...]
    poses: tuple[BonePose, ...]

    def __len__(self) -> int:
        """Number of bones."""
        return len(self.names)

    def check(self) -> None:
        """Raise LumigraphError for no bones, poses of other bones, joints all in one place, and times out of order."""
        count = len(self.names)
        if not count or len(self.parents) != count:
            raise LumigraphError(f"A skeleton has {count} names and {len(self.parents)} parents; give one of each bone")
        if twice := next((name for name in self.names if self.names.count(name) > 1), None):
            raise LumigraphError(f"Two bones are called {twice!r}; rename one")
        for number, parent in enumerate(self.parents):
            if parent >= number:
                raise LumigraphError(
                    f"Bone {self.names[number]} comes before its parent; list the bones from the root on"
                )
        if not self.times or len(self.times) != len(self.poses):
            raise LumigraphError(
                f"A skeleton has {len(self.times)} times and {len(self.poses)} poses; give as many of each"
            )
        if any(a >= b for a, b in zip(self.times, self.times[1:], strict=False)):
            raise LumigraphError("The times of a skeleton's poses do not rise; sort them, and leave out doubles")
        for what, pose in (("rest", self.rest), *((f"poses[{i}]", pose) for i, pose in enumerate(self.poses))):
            if not len(pose.positions) == len(pose.rotations) == count:
                raise LumigraphError(
                    f"{what} has {len(pose.positions)} positions and {len(pose.rotations)} rotations of {count} bones; "
                    "give one of each"
                )
            if not all(any(rotation) for rotation in pose.rotations):
                raise LumigraphError(f"{what} has a rotation of four zeros; give a quaternion (w, x, y, z)")
        if count > 1 and len(set(self.rest.positions)) == 1:
            raise LumigraphError("The joints of a skeleton at rest are all in one place; give the pose of a body")

    def transformed(self, frame: Similarity) -> Skeleton:
        """The same skeleton in another frame."""

        def transform_pose(pose: BonePose) -> BonePose:
            matrices = pose.matrices
            turned = frame.rotation @ matrices[:, :, :3]
            return BonePose.of(torch.cat([turned, frame.points(matrices[:, :, 3])[:, :, None]], -1))

        return replace(self, rest=transform_pose(self.rest), poses=tuple(map(transform_pose, self.poses)))

    def track(self) -> Float[Tensor, "moment bone 3 4"]:
        """Joint-to-frame matrices of all poses, in double precision."""
        return torch.stack([pose.matrices for pose in self.poses])


def local_of(parents: Sequence[int], poses: Float[Tensor, "*batch bone 3 4"]) -> Float[Tensor, "*batch bone 3 4"]:
    """Joints in the frames of their parents; roots unchanged."""
    known = torch.tensor([max(parent, 0) for parent in parents], device=poses.device)
    roots = torch.tensor([parent < 0 for parent in parents], device=poses.device)[:, None, None]
    return torch.where(roots, poses, rigid_product(rigid_inverse(poses[..., known, :, :]), poses))


def posed(parents: Sequence[int], local: Float[Tensor, "*batch bone 3 4"]) -> Float[Tensor, "*batch bone 3 4"]:
    """Joints in one frame from joints in the frames of their parents: forward kinematics."""
    found: list[Tensor] = []
    for number, parent in enumerate(parents):
        own = local[..., number, :, :]
        found.append(own if parent < 0 else rigid_product(found[parent], own))
    return torch.stack(found, -3)


def rigid_product(a: Float[Tensor, "*batch 3 4"], b: Float[Tensor, "*batch 3 4"]) -> Float[Tensor, "*batch 3 4"]:
    """Compose rigid motions: b, then a."""
    turn = a[..., :3] @ b[..., :3]
    return torch.cat([turn, a[..., :3] @ b[..., 3:] + a[..., 3:]], -1)


def rigid_inverse(a: Float[Tensor, "*batch 3 4"]) -> Float[Tensor, "*batch 3 4"]:
    """Inverse of a rigid motion."""
    back = a[..., :3].mT
    return torch.cat([back, -back @ a[..., 3:]], -1)


def between_moments(
    times: Float[Tensor, " moment"], asked: Float[Tensor, " time"]
) -> tuple[Int[Tensor, " time"], Int[Tensor, " time"], Float[Tensor, " time"]]:
    """Indices of the moments before and after each time, and the interpolation weight; clamped to the ends."""
    if len(times) == 1:
        rows = torch.zeros(len(asked), dtype=torch.long, device=asked.device)
        return rows, rows, torch.zeros_like(asked)
    after = torch.searchsorted(times, asked.contiguous(), right=True).clamp(1, len(times) - 1)
    before = after - 1
    share = ((asked - times[before]) / (times[after] - times[before])).clamp(0, 1)
    return before, after, share


def disturbed(
    parents: Sequence[int], pose: Float[np.ndarray, "bone 3 4"], degrees: float, random: np.random.Generator
) -> Float[np.ndarray, "bone 3 4"]:
    """The pose with every joint rotated by `degrees` about a random axis; lengths of bones stay."""
    axes = random.normal(size=(len(parents), 3))
    turned = torch.from_numpy(axes / np.linalg.norm(axes, axis=1, keepdims=True))
    half = 0.5 * math.radians(degrees)
    turn = torch.cat([torch.full_like(turned[:, :1], math.cos(half)), math.sin(half) * turned], 1)
    local = local_of(parents, torch.from_numpy(np.ascontiguousarray(pose)))
    local[:, :, :3] = local[:, :, :3] @ to_matrix(turn)
    return posed(parents, local).numpy()


def retargeted(clip: Skeleton, onto: Skeleton, where: Path | str) -> Skeleton:
    """Retarget the motion of one skeleton to the bones of another with the same names, relative to each rest pose.

    A bone turns in its parent by as much as it does in the clip; roots also move, by lengths of the skeleton. Bones
    missing in the clip keep their rest pose. Raises LumigraphError without common names. where: named in faults
    """
    rows = {name: number for number, name in enumerate(clip.names)}
    shared = [(number, rows[name]) for number, name in enumerate(onto.names) if name in rows]
    if not shared:
        raise LumigraphError(
            f"{where} has no bone of this character: it has {', '.join(clip.names[:6])}, and the character has "
            f"{', '.join(onto.names[:6])}; rename the bones"
        )
    own, other = (torch.tensor(side) for side in zip(*shared, strict=True))
    size = [
        float((s.rest.matrices[:, :, 3] - s.rest.matrices[:, :, 3].mean(0)).norm(dim=1).mean()) for s in (onto, clip)
    ]
    scale = size[0] / size[1] if size[1] else 1.0
    rest, clip_rest = (local_of(s.parents, s.rest.matrices) for s in (onto, clip))
    moves = local_of(clip.parents, clip.track())
    local = rest.expand(len(clip.times), -1, -1, -1).clone()
    turn = clip_rest[other, :, :3].mT @ moves[:, other, :, :3]
    local[:, own, :, :3] = rest[own, :, :3] @ turn
    for mine, its in shared:
        if onto.parents[mine] < 0 and clip.parents[its] < 0:
            turn = rest[mine, :, :3] @ clip_rest[its, :, :3].T
            away = moves[:, its, :, 3] - clip_rest[its, :, 3]
            local[:, mine, :, 3] = rest[mine, :, 3] + scale * away @ turn.T
    poses = tuple(map(BonePose.of, posed(onto.parents, local)))
    return replace(onto, times=clip.times, poses=poses)


def turned_joints(skeleton: Skeleton, angles: dict[str, Point], where: Path | str) -> Skeleton:
    """The skeleton in one pose: at rest, but for joints that turn by angles about their own x, then y, then z axis.

    angles: degrees, by names of bones. Raises LumigraphError for a bone that does not exist. where: named in faults
    """
    local = local_of(skeleton.parents, skeleton.rest.matrices)
    for name, degrees in angles.items():
        if name not in skeleton.names:
            raise LumigraphError(f"{where} turns {name!r}, and there are {', '.join(skeleton.names)}; rename it")
        half = np.radians(degrees) / 2
        turn = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64)
        for axis in range(3):
            one = torch.zeros(1, 4, dtype=torch.float64)
            one[0, 0], one[0, 1 + axis] = np.cos(half[axis]), np.sin(half[axis])
            turn = multiply(one, turn)
        number = skeleton.names.index(name)
        local[number, :, :3] = local[number, :, :3] @ to_matrix(turn)[0]
    return replace(skeleton, times=(0.0,), poses=(BonePose.of(posed(skeleton.parents, local)),))
