"""Poses of held-out photographs for a method with pose optimisation: aligned to its frame, then fitted to their left
halves.

The protocol of Lin 2021 (BARF), section 5.1, which fits them to whole photographs. Scene and poses optimised together
have a frame of their own, so held-out cameras have other poses in it, and a picture shifted by a pixel would score
badly.
"""

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
    """Camera poses of a scene's photographs for a method with pose optimisation.

    `camera(i)` is photograph i's camera: the trained one, or for a held-out photograph the one fitted to its left half.
    Only the pose is optimised, and only the error of colours minimised: no regulariser, no masked pixel. A method with
    codes of photographs renders its average, which is compared up to a gain and an offset of each colour: an untrained
    code would bias the pose, and one fitted at a wrong pose reduces contrast.
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
    """Mean squared error of colours. lit: after the least-squares gain (not negative) and offset of each channel"""
    if lit:
        seen, target = seen - seen.mean(0), target - target.mean(0)
        seen = ((seen * target).mean(0) / seen.square().mean(0).clamp_min(1e-9)).clamp_min(0) * seen
    return (seen - target).square().mean()


def held_out_poses(method: Method, scene: Scene) -> HeldOutPoses | None:
    """Poses for a method that refined poses; None for any other, whose cameras are the given ones."""
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
