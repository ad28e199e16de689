"""Folds: models of structure from motion that have parts of a place twice, or two parts in one place."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Bool, Float

from .normalise import SAMPLED_POINTS, where_axes_meet

JUMP = 10.0  # times the usual distance between neighbours
SAME_WAY = 45.0  # degrees between views; who walks far off seldom looks the same way there
PAIRED = 200  # photographs, every two of which are compared
SHARED = 0.1  # share of what they see, below which two cameras see different places
VIEW = 30.0  # degrees from a camera's axis, about as far as photographs show
STEADY = 0.5  # distance of neighbours, as a share of that of any two, up to which names tell the order of exposure


def jumps(poses: Float[np.ndarray, "photo 3 4"], overlapping: Collection[int] = ()) -> list[tuple[int, float]]:
    """Where cameras in order leap, though they see the same: the one before, and how many times the usual step it is.

    A model that is folded, with parts of the place in it twice or two parts in one place, leaps where the fold is.
    poses:       camera-to-world
    overlapping: photographs that are known to share details with the next; others count where both look the same way
    """
    steps = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=-1)
    same_way = (poses[1:, :, 2] * poses[:-1, :, 2]).sum(-1) > np.cos(np.radians(SAME_WAY))
    usual = float(np.median(steps)) if len(steps) else 0.0
    return [
        (i, float(step / usual))
        for i, step in enumerate(steps)
        if step > JUMP * usual > 0 and (same_way[i] or i in overlapping)
    ]


def in_steps(positions: Float[np.ndarray, "photo 3"]) -> bool:
    """Whether neighbours in the list were taken near each other, as one walks."""
    if len(positions) < 8:
        return False
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=-1)
    some = positions[:: -(-len(positions) // PAIRED)]
    between = np.linalg.norm(some[:, None] - some, axis=-1)
    return bool(np.median(steps) < STEADY * np.median(between[np.triu_indices(len(some), 1)]))


def about_fold(
    names: Sequence[str], poses: Float[np.ndarray, "photo 3 4"], points: Float[np.ndarray, "point 3"] | None
) -> str | None:
    """A sentence about the widest leap between neighbours that look the same way and yet see nothing of what the other
    sees, as where a model has a place twice. None where their order tells nothing, or nobody knows what they see.

    points: sparse points of the model; without them, what all cameras look at stands for what they see
    """
    if not in_steps(poses[:, :, 3]):
        return None
    leaps = [(i, times) for i, times in jumps(poses) if apart(poses[i], poses[i + 1], places_seen(poses, points))]
    if not leaps:
        return None
    i, times = max(leaps, key=lambda leap: leap[1])
    return (
        f"has {names[i]} and {names[i + 1]} next to each other, looking the same way, but {times:.0f} times as far "
        "apart as neighbours usually are, where they see nothing of the same: its model may be folded there; look at "
        "its cameras, and if they are wrong find them anew with `lumigraph capture`"
    )


def places_seen(
    poses: Float[np.ndarray, "photo 3 4"], points: Float[np.ndarray, "point 3"] | None
) -> Float[np.ndarray, "place 3"]:
    """Some of the points; without any, where all axes meet, if they do."""
    if points is not None and len(points):
        return points[:: -(-len(points) // SAMPLED_POINTS)]
    subject, converging = where_axes_meet(poses[:, :, 3], poses[:, :, 2])
    return subject[None] if converging else np.zeros((0, 3))


def apart(a: Float[np.ndarray, "3 4"], b: Float[np.ndarray, "3 4"], places: Float[np.ndarray, "place 3"]) -> bool:
    """Whether two cameras see different places, though they see some."""
    seen_a, seen_b = (in_view(pose, places) for pose in (a, b))
    fewer = min(seen_a.sum(), seen_b.sum())
    return bool(fewer and (seen_a & seen_b).sum() < SHARED * fewer)


def in_view(pose: Float[np.ndarray, "3 4"], places: Float[np.ndarray, "place 3"]) -> Bool[np.ndarray, " place"]:
    towards = places - pose[:, 3]
    return towards @ pose[:, 2] > np.cos(np.radians(VIEW)) * np.linalg.norm(towards, axis=-1)
