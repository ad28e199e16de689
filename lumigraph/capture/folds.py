"""Folds: models of structure from motion that have parts of a place twice, or two parts in one place."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Float

JUMP = 10.0  # times the usual distance between neighbours
SAME_WAY = 45.0  # degrees between views; who walks far off seldom looks the same way there
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
    apart = np.linalg.norm(positions[:, None] - positions, axis=-1)
    return bool(np.median(steps) < STEADY * np.median(apart[np.triu_indices(len(positions), 1)]))


def about_fold(names: Sequence[str], poses: Float[np.ndarray, "photo 3 4"]) -> str | None:
    """A sentence about the widest leap between neighbours that look the same way, where their order tells anything."""
    leaps = jumps(poses) if in_steps(poses[:, :, 3]) else []
    if not leaps:
        return None
    i, times = max(leaps, key=lambda leap: leap[1])
    return (
        f"has {names[i]} and {names[i + 1]} next to each other, looking the same way, but {times:.0f} times as far "
        "apart as neighbours usually are: its model may be folded there; look at its cameras, and if they are wrong "
        "find them anew with `lumigraph capture`"
    )
