"""A tree of boxes around objects, so that a ray asks only those it might meet.

Stored in depth-first order: where a box is missed, the walk jumps to `skip`, past everything inside it. There is no
stack.
"""

from __future__ import annotations

import numpy as np

NODE = np.dtype([("low", "f8", 3), ("high", "f8", 3), ("object", "i8"), ("skip", "i8")])
FAR_DISTANCE = 1e30  # in place of infinity, because infinity times zero is not a number


def hierarchy(boxes: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The tree over boxes (low, high), as an array of NODE.

    Unbounded ones come first; the others are split again and again where a ray then has least to ask (surface area
    heuristic, Goldsmith and Salmon 1987).
    """
    if not boxes:
        return np.zeros(0, NODE)
    low, high = (np.clip(np.array(x).reshape(-1, 3), -FAR_DISTANCE, FAR_DISTANCE) for x in zip(*boxes, strict=True))
    bounded = high[:, 0] < FAR_DISTANCE
    nodes: list[tuple] = []

    def grow(members: np.ndarray) -> None:
        box = low[members].min(0), high[members].max(0)
        if len(members) == 1:
            nodes.append((*box, members[0], len(nodes) + 1))
            return
        place = len(nodes)
        nodes.append(())
        for half in split(low, high, members):
            grow(half)
        nodes[place] = (*box, -1, len(nodes))

    for one in np.flatnonzero(~bounded):
        grow(np.array([one]))
    if bounded.any():
        grow(np.flatnonzero(bounded))
    return np.array(nodes, NODE)


def split(low: np.ndarray, high: np.ndarray, members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two groups whose boxes, weighted by how many each holds, have least surface."""
    if len(members) == 2:
        return members[:1], members[1:]
    best, groups = np.inf, (members[:1], members[1:])
    for axis in range(3):
        order = members[np.argsort((low + high)[members, axis], kind="stable")]
        left = half_surface(np.minimum.accumulate(low[order]), np.maximum.accumulate(high[order]))[:-1]
        back = order[::-1]
        right = half_surface(np.minimum.accumulate(low[back]), np.maximum.accumulate(high[back]))[-2::-1]
        count = np.arange(1, len(members))
        cost = left * count + right * count[::-1]
        if cost.min() < best:
            best, cut = cost.min(), cost.argmin() + 1
            groups = order[:cut], order[cut:]
    return groups


def half_surface(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    x, y, z = (high - low).T
    return x * y + y * z + z * x
