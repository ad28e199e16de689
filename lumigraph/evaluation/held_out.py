"""Kinds of held-out views of a dynamic capture: new cameras, new times, or both."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..datasets.scene import Scene

SAME_MOMENT = 1e-4  # of the capture's duration: two photographs within it are of one moment
SAME_POSE = 1e-4  # largest difference of two poses' numbers that are of one camera
NAMES = {
    (False, False): "new cameras and moments",
    (False, True): "new cameras",
    (True, False): "new moments",
    (True, True): "known cameras and moments",
}


def held_out_kinds(scene: Scene) -> list[str | None]:
    """Kind of each held-out photograph: new camera, new time or both; None for all without times."""
    cameras, times = scene.cameras, scene.frame.times
    if cameras.time is None or times is None:
        return [None] * len(scene)
    train = scene.splits["train"]
    span = SAME_MOMENT * (times[1] - times[0])
    same_moment = among(cameras.time[:, None], cameras.time[train, None], span)
    same_camera = among(cameras.pose.flatten(1), cameras.pose[train].flatten(1), SAME_POSE)
    return [NAMES[pair] for pair in zip(same_camera.tolist(), same_moment.tolist(), strict=True)]


def among(
    rows: Float[Tensor, "row column"], others: Float[Tensor, "other column"], tolerance: float
) -> Bool[Tensor, " row"]:
    """Mask of rows that equal some other row within a tolerance."""
    return torch.cdist(rows.double(), others.double(), p=torch.inf).min(-1).values <= tolerance
