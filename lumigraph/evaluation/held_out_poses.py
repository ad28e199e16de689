"""Poses of held-out photographs for a method that learnt poses: moved into its frame, then found on their left halves.

The protocol of Lin 2021 (BARF), section 5.1, which finds them on whole photographs. What is learnt from photographs and
poses together has a frame of its own, so held-out cameras have other poses in it, and a picture that is off by a pixel
would be scored as wrong.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cached_property

import torch

from ..camera import Camera
from ..components.training.pose_refinement import PoseRefinement
from ..datasets.alignment import aligning, moves
from ..datasets.scene import Scene
from ..geometry import Similarity
from ..method import Method
from ..method.capabilities import RefinesPoses, can, needs
from ..metrics import Score
from .halves import judged_by_halves, left_half

STEPS = 100  # down the error of the left half, the scene frozen
LEARNING_RATE = 5e-3  # radians by which the first step moves the picture
TRUE_POSE = "true_pose"  # of `Scene.about`: camera-to-world in the source's frame
PROTOCOL = (
    "as the method refined them; held-out ones moved along by the similarity that aligns training poses before and "
    f"after, then found on the left halves of their own photographs, {STEPS} steps down the squared error of colours "
    "with the scene frozen (as in Lin 2021, section 5.1, which uses whole photographs)"
)


class HeldOutPoses:
    """Camera poses of a scene's photographs for a method that refines poses.

    `camera(i)` is photograph i's camera: as it was learnt, or if it was not learnt from, as it is found on its left
    half. Nothing but this pose is free, and what is minimised is the error of colours alone: no regulariser, no pixel
    left out. Colours are in the appearance that the left half has from the camera moved along, where the method has
    codes of photographs: a code that was never learnt would pull at the pose.
    """

    def __init__(self, method: Method, scene: Scene):
        learnt, self.scene, self.method = scene.splits["train"], scene, method
        given = scene.cameras[learnt].to("cpu")
        self.moved_along = scene.cameras.transformed(aligning(given, method.refined(given)).matrix)
        self.learnt = set(learnt.tolist())

    @cached_property
    def frozen(self) -> Method:
        return copy.deepcopy(self.method).requires_grad_(False)

    def camera(self, index: int) -> Camera:
        if index in self.learnt:
            return self.method.refined(self.scene.cameras[index])
        begin = self.moved_along[index]
        shot = left_half(replace(self.scene.photograph(index), camera=begin))
        if shot.mask is None or not shot.mask.any():
            return begin
        method = needs(self.frozen.given(shot) if judged_by_halves(self.frozen) else self.frozen, RefinesPoses)
        poses = PoseRefinement(len(self.scene), LEARNING_RATE).to(method.device)
        poses.choose_axes(begin, self.scene.frame)
        (optimizer,), generator = poses.optimizers(), torch.Generator().manual_seed(index)
        with torch.enable_grad():
            for step in range(STEPS):
                optimizer.param_groups[0]["lr"] = poses.rate(step / STEPS)
                error = method.pose_error(shot, poses, generator)
                (poses.twist.grad,) = torch.autograd.grad(error, [poses.twist])
                optimizer.step()
        return poses.refined(begin)


def held_out_poses(method: Method, scene: Scene) -> HeldOutPoses | None:
    """For a method that refined poses; None for any other, which sees photographs from where they were taken."""
    return HeldOutPoses(method, scene) if can(method, RefinesPoses) else None


def pose_scores(method: Method, scene: Scene) -> list[Score]:
    """Errors of rotation (degrees) and position (percent of the box of interest) against true poses, aligned; medians
    over training photographs. Empty where the true poses are unknown."""
    if TRUE_POSE not in scene.about:
        return []
    learnt = scene.splits["train"]
    cameras = scene.cameras[learnt].to("cpu")
    to_scene = Similarity.of(scene.frame.source_from_scene).inverse
    truth = replace(cameras, pose=scene.about[TRUE_POSE][learnt]).transformed(to_scene.matrix)
    turned, shifted = moves(method.refined(cameras), truth, scene.frame).median
    return [
        Score("rotation error", turned, "degrees", "lower", 3),
        Score("position error", shifted, "% of the extent", "lower", 3),
    ]
