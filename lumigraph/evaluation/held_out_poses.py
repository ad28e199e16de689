"""Poses of held-out photographs for a method that learnt poses: moved into its frame, then found on their left halves.

The protocol of Lin 2021 (BARF), section 5.1, which finds them on whole photographs. What is learnt from photographs and
poses together has a frame of its own, so held-out cameras have other poses in it, and a picture that is off by a pixel
would be scored as wrong.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..components.training.pose_refinement import PoseRefinement
from ..datasets.alignment import aligning, moves
from ..datasets.scene import Scene
from ..geometry import Similarity
from ..method import Method, frozen
from ..method.capabilities import RefinesPoses, can, needs
from ..metrics import Score
from .halves import judged_by_halves, left_half

STEPS = 200  # down the error of the left half, the scene frozen
LEARNING_RATE = 1e-2  # radians by which the first step moves the picture
MIN_ALIGNED = 3  # photographs that errors of poses are measured on
TRUE_POSE = "true_pose"  # of `Scene.about`: camera-to-world in the source's frame
PROTOCOL = (
    "as the method refined them; held-out ones moved along by the similarity that aligns training poses before and "
    f"after, then found on the left halves of their own photographs, {STEPS} steps down the squared error of colours "
    "(up to a gain and an offset for methods that find codes) with the scene frozen (Lin 2021, section 5.1, which "
    "uses whole photographs)"
)


class HeldOutPoses:
    """Camera poses of a scene's photographs for a method that refines poses.

    `camera(i)` is photograph i's camera: as it was learnt, or if it was not learnt from, as it is found on its left
    half. Nothing but this pose is free, and what is minimised is the error of colours alone: no regulariser, no pixel
    left out. A method with codes of photographs shows its average, which is compared up to a gain and an offset of each
    colour: a code that was never learnt would pull at the pose, and one found from a wrong pose takes contrast away.
    """

    def __init__(self, method: Method, scene: Scene):
        train = scene.splits["train"]
        given = scene.cameras[train].to("cpu")
        refined = method.refined(given)
        self.scene, self.method = scene, method
        self.moved_along = scene.cameras.transformed(aligning(given, refined).matrix)
        self.learnt = set() if refined is given else set(train.tolist())  # blocks know no poses in the common frame

    def camera(self, index: int) -> Camera:
        if index in self.learnt:
            return self.method.refined(self.scene.cameras[index])
        begin = self.moved_along[index]
        shot = left_half(replace(self.scene.photograph(index), camera=begin))
        if shot.mask is None or not shot.mask.any():
            return begin
        poses = PoseRefinement(len(self.scene), LEARNING_RATE).to(self.method.device)
        poses.choose_axes(begin, self.scene.frame)
        (optimizer,), generator = poses.optimizers(), torch.Generator().manual_seed(index)
        pairs, lit = needs(self.method, RefinesPoses).colour_pairs(shot), judged_by_halves(self.method)
        with frozen(self.method), torch.enable_grad():
            for step in range(STEPS):
                optimizer.param_groups[0]["lr"] = poses.rate(step / STEPS)
                seen, target = pairs(poses, generator)
                (poses.twist.grad,) = torch.autograd.grad(colour_error(seen, target, lit), [poses.twist])
                optimizer.step()
        return poses.refined(begin)


def colour_error(
    seen: Float[Tensor, "pixel 3"], target: Float[Tensor, "pixel 3"], lit: bool = False
) -> Float[Tensor, ""]:
    """Mean squared error of colours. lit: after the gain, not negative, and the offset of each that leave least"""
    if lit:
        seen, target = seen - seen.mean(0), target - target.mean(0)
        seen = ((seen * target).mean(0) / seen.square().mean(0).clamp_min(1e-9)).clamp_min(0) * seen
    return (seen - target).square().mean()


def held_out_poses(method: Method, scene: Scene) -> HeldOutPoses | None:
    """For a method that refined poses; None for any other, which sees photographs from where they were taken."""
    return HeldOutPoses(method, scene) if can(method, RefinesPoses) else None


def pose_scores(method: Method, scene: Scene) -> list[Score]:
    """Errors of rotation (degrees) and position (percent of the box of interest) against true poses, aligned; medians
    over training photographs. Empty where the true poses are unknown, or the refined ones of blocks, and for so few
    photographs that any alignment would fit them."""
    if TRUE_POSE not in scene.about or len(learnt := scene.splits["train"]) < MIN_ALIGNED:
        return []
    cameras = scene.cameras[learnt].to("cpu")
    if can(method, RefinesPoses) and method.refined(cameras) is cameras:
        return []
    to_scene = Similarity.of(scene.frame.source_from_scene).inverse
    truth = replace(cameras, pose=scene.about[TRUE_POSE][learnt]).transformed(to_scene.matrix)
    turned, shifted = moves(method.refined(cameras), truth, scene.frame).median
    return [
        Score("rotation error", turned, "degrees", "lower", 3),
        Score("position error", shifted, "% of the extent", "lower", 3),
    ]
