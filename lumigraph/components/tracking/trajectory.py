"""Trajectory: the pose of each frame of a moving camera, and its tracking state."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...camera import Camera
from ...datasets.scene import Scene
from ...geometry import rotated
from ...method import Part

UNKNOWN, LOST, KNOWN, UNMEASURED, UNEXPLAINED, CONTRADICTED = range(6)  # states of a frame
LOSSES = {
    LOST: "too few of its features match known frames",
    UNMEASURED: "its depth was not measured",
    UNEXPLAINED: "the map does not explain its depth",
    CONTRADICTED: "its depth contradicts that of known frames",
}

Pose = Float[Tensor, "3 4"]
Twist = Float[Tensor, "pose 6"]  # rotation vector in the world's axes about the camera, then shift in scene units


class Trajectory(Part):
    """Poses of all frames, camera-to-world, scene units, by their image number.

    state:  UNKNOWN before tracking, KNOWN, or one of LOSSES where tracking failed
    anchor: keyframe beside which a frame was tracked: the frame moves with corrections of the keyframe's pose
    tracks: whether poses are estimated; otherwise they are those of the cameras
    """

    moves_cameras: ClassVar[bool] = True
    poses: Tensor
    state: Tensor
    anchor: Tensor

    def __init__(self, image_count: int):
        super().__init__()
        self.register_buffer("poses", torch.eye(3, 4).repeat(image_count, 1, 1))
        self.register_buffer("state", torch.zeros(image_count, dtype=torch.int64))
        self.register_buffer("anchor", torch.full((image_count,), -1))

    @torch.no_grad()
    def begin(self, method: object, data: Scene, seconds: float) -> None:
        self.poses.copy_(data.cameras.pose)

    def know(self, index: int, pose: Pose, anchor: int) -> None:
        self.poses[index] = rigid(pose[None])[0]
        self.state[index], self.anchor[index] = KNOWN, anchor

    def lose(self, index: int, pose: Pose, reason: int = LOST) -> None:
        """Keep the last known pose for a frame where tracking failed. reason: of LOSSES"""
        self.poses[index], self.state[index] = pose, reason

    def predicted(self, before: list[int]) -> Pose:
        """Pose of the next frame at constant velocity. before: the two frames before, the later one first"""
        last = self.poses[before[0]]
        if len(before) < 2 or (self.state[before[:2]] != KNOWN).any():
            return last.clone()
        return moved(last, *relative(self.poses[before[1]], last))

    def speed(self, images: list[int]) -> tuple[float, float]:
        """Median motion from each of these frames to the next one: scene units, radians; infinity for no two frames."""
        if len(images) < 2:
            return math.inf, math.inf
        turns, shifts = zip(*(relative(self.poses[a], self.poses[b]) for a, b in pairwise(images)), strict=True)
        return float(torch.stack(shifts).norm(dim=-1).median()), float(angle(torch.stack(turns)).median())

    def correct(self, keyframes: Int[Tensor, " keyframe"], twists: Twist) -> None:
        """Correct keyframes by twists, and the frames anchored to them."""
        self.place(keyframes.tolist(), apply_twists(self.poses[keyframes], twists))

    @torch.no_grad()
    def place(self, keyframes: list[int], poses: Float[Tensor, "keyframe 3 4"]) -> None:
        """Set poses of keyframes, and move the frames anchored to them."""
        for keyframe, pose in zip(keyframes, rigid(poses), strict=True):
            beside = self.anchor == keyframe
            self.poses[beside] = rigid(moved(pose, *relative(self.poses[keyframe], self.poses[beside])))
            self.poses[keyframe] = pose

    @torch.no_grad()
    def refined(self, cameras: Camera) -> Camera:
        """Cameras of frames with estimated poses; others stay."""
        if cameras.image_index is None:
            return cameras
        index = cameras.image_index.to(self.poses.device)
        found = (self.state[index] != UNKNOWN)[:, None, None]
        pose = torch.where(found, self.poses[index], cameras.pose.to(self.poses))
        return replace(cameras, pose=pose.to(cameras.pose))


def relative(first: Pose, second: Float[Tensor, "*frame 3 4"]) -> tuple[Tensor, Tensor]:
    """Rotation and shift of poses in the frame of the first: first^-1 second."""
    back = first[:, :3].T
    return back @ second[..., :3], (second[..., 3] - first[:, 3]) @ back.T


def moved(pose: Pose, turn: Float[Tensor, "*frame 3 3"], shift: Float[Tensor, "*frame 3"]) -> Tensor:
    """Poses after a rotation and a shift in the frame of the first; the inverse of `relative`."""
    return torch.cat([pose[:, :3] @ turn, (shift @ pose[:, :3].T + pose[:, 3])[..., None]], -1)


def angle(turn: Float[Tensor, "*pose 3 3"]) -> Float[Tensor, "*pose"]:
    """Angle of rotations, radians."""
    return torch.arccos(((turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))


def apply_twists(poses: Float[Tensor, "pose 3 4"], twists: Twist) -> Float[Tensor, "pose 3 4"]:
    """Poses turned about their own positions and shifted; differentiable in the twists."""
    omega, shift = twists.split(3, -1)
    axes = [rotated(poses[:, :, i], omega) for i in range(3)]
    return torch.stack([*axes, poses[:, :, 3] + shift], -1)


def rigid(poses: Float[Tensor, "pose 3 4"]) -> Float[Tensor, "pose 3 4"]:
    """Poses with the nearest exact rotations."""
    u, _, vt = torch.linalg.svd(poses[:, :, :3].double())
    return torch.cat([(u @ vt).to(poses), poses[:, :, 3:]], -1)
