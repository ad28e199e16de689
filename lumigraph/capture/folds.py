"""Folds: models of structure from motion that have parts of a place twice, or two parts in one place."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from PIL import Image

from .capture import Shot

JUMP_FACTOR = 10.0  # times the usual distance between neighbours
MAX_VIEW_ANGLE = 45.0  # degrees between views; who walks far off seldom looks the same way there
MAX_PAIRED_VIEWS = 200  # photographs, every two of which are compared
CHECKED_JUMPS = 4  # widest jumps whose photographs are compared
SAME_VIEW_FACTOR = 1.25  # times the difference to adjacent photographs; up to it two photographs show the same
THUMBNAIL_SIDE = 16  # pixels
ORDER_SHARE = 0.5  # distance of neighbours, as a share of that of any two, up to which names give the order of exposure


def jumps(poses: Float[np.ndarray, "photo 3 4"], overlapping: Collection[int] = ()) -> list[tuple[int, float]]:
    """Leaps between consecutive cameras that see the same: the camera before, and the leap over the usual step.

    A model that is folded, with parts of the place in it twice or two parts in one place, leaps where the fold is.
    poses:       camera-to-world
    overlapping: photographs that are known to share details with the next; others count where both look the same way
    """
    steps = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=-1)
    same_way = (poses[1:, :, 2] * poses[:-1, :, 2]).sum(-1) > np.cos(np.radians(MAX_VIEW_ANGLE))
    usual = float(np.median(steps)) if len(steps) else 0.0
    return [
        (i, float(step / usual))
        for i, step in enumerate(steps)
        if step > JUMP_FACTOR * usual > 0 and (same_way[i] or i in overlapping)
    ]


def in_steps(positions: Float[np.ndarray, "photo 3"]) -> bool:
    """True if neighbours in the list were taken near each other, as on a walk."""
    if len(positions) < 8:
        return False
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=-1)
    some = positions[:: -(-len(positions) // MAX_PAIRED_VIEWS)]
    between = np.linalg.norm(some[:, None] - some, axis=-1)
    return bool(np.median(steps) < ORDER_SHARE * np.median(between[np.triu_indices(len(some), 1)]))


def about_fold(shots: Sequence[Shot], poses: Float[np.ndarray, "photo 3 4"]) -> str | None:
    """A sentence about the widest leap between neighbours whose photographs show the same, if there is one and the
    order of photographs tells anything.

    Those of each published split are a list of their own. Photographs are looked at only where cameras leap.
    """
    groups = [[i for i, shot in enumerate(shots) if shot.split == split] for split in {shot.split for shot in shots}]
    leaps = [
        (times, group[i : i + 2])
        for group in groups
        for i, times in leaps_alike([shots[k] for k in group], poses[group])
    ]
    if not leaps:
        return None
    times, (before, after) = max(leaps)
    return (
        f"has {shots[before].name} and {shots[after].name} next to each other, showing the same, but {times:.0f} times "
        "as far apart as neighbours usually are: its model may be folded there; look at its cameras, and if they are "
        "wrong find them anew with `lumigraph capture`"
    )


def leaps_alike(shots: Sequence[Shot], poses: Float[np.ndarray, "photo 3 4"]) -> list[tuple[int, float]]:
    """The widest jumps, whichever way cameras look, across which photographs differ no more than beside them."""
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
    """A photograph in a few grey pixels, whatever its exposure; None where no file holds it."""
    if not isinstance(shot.image, dict):
        return None
    try:
        with Image.open(shot.image[max(shot.image)]) as image:
            image.draft("L", (4 * THUMBNAIL_SIDE, 4 * THUMBNAIL_SIDE))
            grey = np.asarray(
                image.convert("L").resize((THUMBNAIL_SIDE, THUMBNAIL_SIDE), Image.Resampling.BOX), np.float64
            )
    except OSError:  # said where it is read
        return None
    return (grey - grey.mean()) / max(float(grey.std()), 1.0)
