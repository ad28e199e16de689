"""A cloud is sound before it leaves this room, in either direction: all of its numbers are finite."""

from __future__ import annotations

from dataclasses import replace

import torch

from ..errors import LumigraphError
from ..gaussians import Gaussians

SPOKEN = {"means": "means", "quaternions": "rotations", "log_scales": "scales", "harmonics": "colours"}
CERTAIN = 20.0  # a logit whose sigmoid is 1 in float32


def checked(gaussians: Gaussians, subject: str, way_out: str) -> Gaussians:
    """The same cloud, with ±20 for infinite logits of opacity and no rotation for quaternions of length zero.

    Raises LumigraphError, which begins with `subject` and ends with `way_out`, if other numbers are not finite.
    """
    if (count := gaussians.harmonics.shape[1]) not in (1, 4, 9, 16):
        raise LumigraphError(f"{subject} has {count} harmonics per Gaussian; bring them to 1, 4, 9 or 16")
    unsound = {what: ~getattr(gaussians, name).isfinite().flatten(1).all(-1) for name, what in SPOKEN.items()}
    unsound["opacities"] = gaussians.opacities.isnan()
    faults = [f"{what}: {int(bad.sum())}" for what, bad in unsound.items() if bad.any()]
    if faults:
        count = int(torch.stack(list(unsound.values())).any(0).sum())
        raise LumigraphError(
            f"{subject} holds {count} of {len(gaussians)} Gaussians with numbers that are not finite "
            f"({', '.join(faults)}); {way_out}"
        )
    nowhere = (gaussians.quaternions == 0).all(-1, keepdim=True)
    return replace(
        gaussians,
        quaternions=torch.where(nowhere, gaussians.quaternions.new_tensor([1, 0, 0, 0]), gaussians.quaternions),
        opacities=gaussians.opacities.nan_to_num(float("nan"), CERTAIN, -CERTAIN),
    )
