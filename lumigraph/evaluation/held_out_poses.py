"""Held-out photographs for a method that learnt poses: moved into the frame that it learnt, then found on themselves.

The protocol of Lin 2021 (BARF), section 5.1. What is learnt from photographs and poses together has a frame of its own,
so held-out cameras have other poses in it, and a picture that is off by a pixel would be scored as wrong.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch

from ..camera import Camera
from ..components.training.pose_refinement import PoseRefinement
from ..datasets.alignment import aligning, moves
from ..datasets.scene import Scene
from ..geometry import Similarity
from ..method import Method
from ..method.capabilities import RefinesPoses, can
from ..metrics import Score

STEPS = 100  # down the photograph's own loss, the scene frozen
LEARNING_RATE = 5e-3  # radians by which the first step moves the picture
TRUE_POSE = "true_pose"  # of `Scene.about`: camera-to-world in the source's frame
PROTOCOL = (
    "as the method refined them; held-out ones moved along by the similarity that aligns training poses before and "
    f"after, then refined on their own photographs, {STEPS} steps with the scene frozen (Lin 2021, section 5.1)"
)


class HeldOutPoses:
    """Camera poses of a scene's photographs for a method that refines poses.

    `camera(i)` is photograph i's camera: as it was learnt, or if it was not learnt from, as it is found here. A copy of
    the method learns it by the method's own loss, with nothing but this pose free.
    """

    def __init__(self, method: Method, scene: Scene):
        learnt, self.photographs, self.method = scene.splits["train"], scene.cameras, method
        given = scene.cameras[learnt].to("cpu")
        moved_along = scene.cameras.transformed(aligning(given, method.refined(given)).matrix)
        self.scene, self.learnt = replace(scene, cameras=moved_along), set(learnt.tolist())

    @cached_property
    def frozen(self) -> Any:
        return copy.deepcopy(self.method).requires_grad_(False)

    def camera(self, index: int) -> Camera:
        if index in self.learnt:
            return self.method.refined(self.photographs[index])
        alone = replace(self.scene, splits={"train": torch.tensor([index])})
        poses = PoseRefinement(self.scene.frame.image_count, LEARNING_RATE).to(self.method.device)
        poses.choose_axes(self.scene.cameras[index], self.scene.frame)
        self.frozen.poses = poses
        (optimizer,), generator = poses.optimizers(), torch.Generator().manual_seed(index)
        with torch.enable_grad():
            for step in range(STEPS):
                optimizer.param_groups[0]["lr"] = poses.rate(step / STEPS)
                optimizer.zero_grad()
                terms = self.frozen.loss(self.frozen.batch(alone, generator), step)
                torch.stack(list(terms.values())).sum().backward()
                optimizer.step()
        return poses.refined(self.scene.cameras[index])


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
