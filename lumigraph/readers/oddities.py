"""Warnings of captures that are well-formed but implausible, before training."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from PIL import Image

from ..errors import LumigraphError
from ..files.names import counted
from .capture import Capture, Shot
from .normalise import MIN_CONVERGENCE, SAMPLED_POINTS

MIN_RELATIVE_SPREAD = 1e-9  # spread of cameras, as a share of their distance from the origin
ZERO_SPREAD, MIN_SPREAD, MAX_SPREAD = 1e-9, 1e-6, 1e6  # units between cameras: zero, and the plausible range
MIN_FIELD_OF_VIEW, MAX_FIELD_OF_VIEW = 0.5, 175.0  # degrees of a flat picture, across its longer side
MAX_AXIS_OFFSET = 0.1  # distance to an axis, as a share of the distance, at which axes still meet
MIN_VISIBLE_SHARE = 0.1  # share of the points in front of the median camera, below which cameras look away from them
JUMP_FACTOR = 10.0  # times the usual distance between neighbours
MAX_VIEW_ANGLE = 45.0  # degrees between views; who walks far off seldom looks the same way there
MAX_PAIRED_VIEWS = 200  # photographs, every two of which are compared
CHECKED_JUMPS = 4  # widest jumps whose photographs are compared
SAME_PLACE_SHARE = 1e-6  # of the whole way, below which two cameras are in one place
SAME_VIEW_FACTOR = 1.25  # times the difference to adjacent photographs; up to it two photographs show the same
THUMBNAIL_SIDE = 16  # pixels
ORDER_SHARE = 0.5  # distance of neighbours, as a share of that of any two, up to which names give the order of exposure


def oddities(capture: Capture, shots: list[Shot], poses: Float[np.ndarray, "camera 3 4"]) -> list[str]:
    """Warnings of a capture; none where its source has bounds."""
    if capture.bounds is not None:
        return []
    found = [about_double(shots), about_places(poses), about_gaze(capture, poses), about_angles(shots)]
    if not any("folded" in sentence for sentence in capture.notes):  # the reader may know more
        found.append(about_fold(shots, poses))
    return [f"{capture.source} {sentence}" for sentence in found if sentence]


def about_double(shots: list[Shot]) -> str | None:
    """Warning of photographs listed more than once, by file."""
    files = [str(shot.image[min(shot.image)]) if isinstance(shot.image, dict) else shot.name for shot in shots]
    double = [name for name, count in Counter(files).items() if count > 1]
    if not double:
        return None
    number = counted(len(double), "photograph")
    return f"lists {number} more than once, such as {Path(double[0]).name}; keep one frame of each"


def about_places(poses: Float[np.ndarray, "camera 3 4"]) -> str | None:
    """Warning of cameras in one place, and of implausible units. LumigraphError for vanishing distances."""
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
    """Warning of cameras that all look away from where their axes meet, and from the points if any."""
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
    """Warning of implausible focal lengths."""
    for shot in shots:
        focal = getattr(shot.lens, "focal", None)
        if focal is None or shot.size is None:
            continue
        angle = float(np.degrees(2 * np.arctan(0.5 * max(shot.size) / float(focal.min()))))
        if not MIN_FIELD_OF_VIEW < angle < MAX_FIELD_OF_VIEW:
            return f"has a lens that sees {angle:.3g} degrees, that of {shot.name}; check its focal length"
    return None


def jumps(poses: Float[np.ndarray, "photo 3 4"], overlapping: Collection[int] = ()) -> list[tuple[int, float]]:
    """Jumps between consecutive cameras with overlapping views: index of the camera before, and distance over the usual
    step.

    A folded model, with parts of the place in it twice or two parts in one place, jumps at the fold.
    poses:       camera-to-world
    overlapping: photographs known to share features with the next; others count if both look the same way
    """
    steps = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=-1)
    same_way = (poses[1:, :, 2] * poses[:-1, :, 2]).sum(-1) > np.cos(np.radians(MAX_VIEW_ANGLE))
    usual = float(np.median(steps)) if len(steps) else 0.0
    if usual < SAME_PLACE_SHARE * steps.sum():  # several views from each place, as of a panorama
        return []
    return [
        (i, float(step / usual))
        for i, step in enumerate(steps)
        if step > JUMP_FACTOR * usual > 0 and (same_way[i] or i in overlapping)
    ]


def in_steps(positions: Float[np.ndarray, "photo 3"]) -> bool:
    """True if consecutive photographs were taken near each other, as on a walk."""
    if len(positions) < 8:
        return False
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=-1)
    some = positions[:: -(-len(positions) // MAX_PAIRED_VIEWS)]
    between = np.linalg.norm(some[:, None] - some, axis=-1)
    return bool(np.median(steps) < ORDER_SHARE * np.median(between[np.triu_indices(len(some), 1)]))


def about_fold(shots: Sequence[Shot], poses: Float[np.ndarray, "photo 3 4"]) -> str | None:
    """Warning of a possible fold, or None."""
    found = fold(shots, poses)
    return found and (
        f"has {found.before} and {found.after} next to each other, showing the same, but {found.times:.0f} times "
        "as far apart as neighbours usually are: its model may be folded there; look at its cameras, and if they are "
        "wrong find them anew with `lumigraph capture`"
    )


class Fold(NamedTuple):
    """Names of two consecutive photographs with the same view, and their cameras' distance over the usual one."""

    before: str
    after: str
    times: float


def fold(shots: Sequence[Shot], poses: Float[np.ndarray, "photo 3 4"]) -> Fold | None:
    """Largest jump between consecutive photographs with the same view, if any and if their order is meaningful.

    Each published split is a list of its own. Photographs are read only where cameras jump.
    """
    groups = [[i for i, shot in enumerate(shots) if shot.split == split] for split in {shot.split for shot in shots}]
    found = [(group, leaps_alike([shots[k] for k in group], poses[group])) for group in groups]
    leaps = [(times, group[i : i + 2]) for group, own in found for i, times in own]
    if not leaps:
        return None
    times, (before, after) = max(leaps)
    return Fold(shots[before].name, shots[after].name, times)


def leaps_alike(shots: Sequence[Shot], poses: Float[np.ndarray, "photo 3 4"]) -> list[tuple[int, float]]:
    """Largest jumps, in any viewing direction, across which photographs differ no more than beside them."""
    if not in_steps(poses[:, :, 3]):
        return []
    found = sorted(jumps(poses, range(len(poses))), key=lambda jump: -jump[1])[:CHECKED_JUMPS]
    return [(i, times) for i, times in found if 0 < i < len(poses) - 2 and alike(shots[i - 1 : i + 3])]


def alike(four: Sequence[Shot]) -> bool:
    """True if the middle two of four photographs in a row differ no more than the outer pairs do."""
    seen = [picture for shot in four if (picture := thumbnail(shot)) is not None]
    if len(seen) < len(four):
        return False
    before, between, after = (float(np.abs(b - a).mean()) for a, b in pairwise(seen))
    return between < SAME_VIEW_FACTOR * max(before, after)


def thumbnail(shot: Shot) -> Float[np.ndarray, "row column"] | None:
    """A photograph in a few grey pixels, normalised by exposure; None without a file."""
    if not isinstance(shot.image, dict):
        return None
    try:
        with Image.open(shot.image[max(shot.image)]) as image:
            image.draft("L", (4 * THUMBNAIL_SIDE, 4 * THUMBNAIL_SIDE))
            small = image.convert("L").resize((THUMBNAIL_SIDE, THUMBNAIL_SIDE), Image.Resampling.BOX)
            grey = np.asarray(small, np.float64)
    except OSError:  # said where it is read
        return None
    return (grey - grey.mean()) / max(float(grey.std()), 1.0)
