"""A cloud is sound before it leaves this room, in either direction: all of its numbers are finite."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from ..errors import LumigraphError
from ..gaussians import Gaussians
from ..system.memory import free_memory

DISPLAY_NAMES = {"means": "means", "quaternions": "rotations", "log_scales": "scales", "harmonics": "colours"}
MAX_LOGIT = 20.0  # a logit whose sigmoid is 1 in float32
BYTES_PER_NUMBER = (
    28  # bytes that each number of a Gaussian takes while its file is read: itself, and what it is made from
)
MAX_RATIO, SMALL_BYTES = (
    100,
    1 << 26,
)  # times that clouds can be packed, and unpacked bytes up to which any share is believed


def check_room(path: Path, count: int, harmonics: int = 1, packed: int | None = None, unpacked: int = 0) -> None:
    """Raise LumigraphError for a cloud that the machine cannot hold, or that its file can only pretend to hold.

    count, harmonics: Gaussians that the file promises, and coefficients of each
    packed, unpacked: bytes of a compressed file, and what they would become
    """
    if packed is not None and unpacked > max(SMALL_BYTES, MAX_RATIO * packed):
        raise LumigraphError(
            f"{path} promises {count:,} Gaussians in {packed:,} bytes, which no cloud can be packed into; "
            "copy or download it again"
        )
    needed, free = BYTES_PER_NUMBER * (11 + 3 * harmonics) * count, free_memory()
    if needed > free:
        raise LumigraphError(
            f"{path} promises {count:,} Gaussians, which take {needed / 1e9:.1f} GB to read, and {free / 1e9:.1f} GB "
            "are free; reduce it with an editor of splats, or take a larger machine"
        )


def checked(gaussians: Gaussians, subject: str, way_out: str) -> Gaussians:
    """The same cloud, with ±20 for infinite logits of opacity and no rotation for quaternions of length zero.

    Raises LumigraphError, which begins with `subject` and ends with `way_out`, if other numbers are not finite.
    """
    if (count := gaussians.harmonics.shape[1]) not in (1, 4, 9, 16):
        raise LumigraphError(f"{subject} has {count} harmonics per Gaussian; bring them to 1, 4, 9 or 16")
    unsound = {what: ~getattr(gaussians, name).isfinite().flatten(1).all(-1) for name, what in DISPLAY_NAMES.items()}
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
        opacities=gaussians.opacities.nan_to_num(float("nan"), MAX_LOGIT, -MAX_LOGIT),
    )
