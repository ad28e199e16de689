"""Warn of captures that are well-formed but implausible, in a sentence each, before training begins."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..errors import LumigraphError
from .capture import Capture, Shot
from .folds import about_fold
from .normalise import MIN_CONVERGENCE, SAMPLED_POINTS

MIN_RELATIVE_SPREAD = 1e-9  # spread of cameras, as a share of their distance from the origin
ZERO_SPREAD, MIN_SPREAD, MAX_SPREAD = (
    1e-9,
    1e-6,
    1e6,
)  # units between cameras: zero for computation, implausibly small, implausibly large
MIN_FIELD_OF_VIEW, MAX_FIELD_OF_VIEW = 0.5, 175.0  # degrees of a flat picture, across its longer side
MAX_AXIS_OFFSET = 0.1  # distance to an axis, as a share of the distance, at which axes still meet
MIN_VISIBLE_SHARE = 0.1  # share of the points in front of the median camera, below which cameras look away from them


def oddities(capture: Capture, shots: list[Shot], poses: Float[np.ndarray, "camera 3 4"]) -> list[str]:
    """Sentences about a capture that its source says nothing of; none where it says where everything is."""
    if capture.bounds is not None:
        return []
    found = [about_double(shots), about_places(poses), about_gaze(capture, poses), about_angles(shots)]
    if not any("folded" in sentence for sentence in capture.notes):  # the reader may know more
        found.append(about_fold(shots, poses))
    return [f"{capture.source} {sentence}" for sentence in found if sentence]


def about_double(shots: list[Shot]) -> str | None:
    """Photographs that are listed more than once, by the file that they are."""
    files = [str(shot.image[min(shot.image)]) if isinstance(shot.image, dict) else shot.name for shot in shots]
    double = [name for name, count in Counter(files).items() if count > 1]
    if not double:
        return None
    number = f"{len(double)} photograph{'' if len(double) == 1 else 's'}"
    return f"lists {number} more than once, such as {Path(double[0]).name}; keep one frame of each"


def about_places(poses: Float[np.ndarray, "camera 3 4"]) -> str | None:
    """Cameras in one place, and units in which nothing is measured. LumigraphError where nobody can count in them."""
    place = poses[:, :, 3]
    spread = float(np.linalg.norm(place - place.mean(0), axis=-1).max())
    if spread <= MIN_RELATIVE_SPREAD * float(np.abs(place).max()):
        alike = np.abs(poses - poses[0]).max() < 1e-9
        return (
            f"has {len(poses)} photographs with {'one and the same pose' if alike else 'poses in one place'}, which "
            "tells nothing of depth; check the file of poses, or take photographs a step apart"
        )
    if spread < ZERO_SPREAD:
        raise LumigraphError(f"The cameras are {spread:.3g} units apart at most; give their poses in another unit")
    if not MIN_SPREAD < spread < MAX_SPREAD:
        return f"has cameras {spread:.3g} units apart at most; check the unit of its poses"
    return None


def about_gaze(capture: Capture, poses: Float[np.ndarray, "camera 3 4"]) -> str | None:
    """Cameras that look away from where their axes meet, all of them, and from the points if there are any."""
    place, forward = poses[:, :, 3], poses[:, :, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None]
    if np.linalg.eigvalsh(across.mean(0))[0] < MIN_CONVERGENCE:
        return None
    meeting = np.linalg.solve(across.sum(0), (across @ place[:, :, None]).sum(0))[:, 0]
    towards = meeting - place
    miss = np.linalg.norm((across @ towards[:, :, None])[:, :, 0], axis=-1)
    if ((towards * forward).sum(-1) > -ZERO_SPREAD).any() or (
        miss > MAX_AXIS_OFFSET * np.linalg.norm(towards, axis=-1)
    ).any():
        return None
    if capture.points is not None and len(capture.points):
        points = capture.points[:: -(-len(capture.points) // SAMPLED_POINTS)]
        ahead = np.einsum("cpk,ck->cp", points - place[:, None], forward) > 0
        if np.median(ahead.mean(1)) > MIN_VISIBLE_SHARE:
            return None
    return (
        "has cameras that all look away from the place where their axes meet; unless they stood in the middle, their "
        "poses are of another convention than the file's"
    )


def about_angles(shots: list[Shot]) -> str | None:
    """Focal lengths that no lens before such a picture has."""
    for shot in shots:
        focal = getattr(shot.lens, "focal", None)
        if focal is None or shot.size is None:
            continue
        angle = float(np.degrees(2 * np.arctan(0.5 * max(shot.size) / float(focal.min()))))
        if not MIN_FIELD_OF_VIEW < angle < MAX_FIELD_OF_VIEW:
            return f"has a lens that sees {angle:.3g} degrees, that of {shot.name}; check its focal length"
    return None
