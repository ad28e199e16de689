"""Street crossings, found from where photographs were taken: places from which three ways or more leave, and corners
between them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

GRAPH_NEIGHBOURS = 12  # candidate positions for the way to the next one
STEP_QUANTILE = 0.9  # of the spanning tree's edges; rigs take many photographs at one place
INNER_RADIUS, OUTER_RADIUS = 1.5, 3.5  # steps around a position, between which outgoing streets are counted
MIN_STREET_ANGLE = np.radians(45)  # between two streets
MIN_CORNER_ANGLE = np.radians(225)  # of the outer side of a corner
CROSSING_RADIUS = 2.5  # steps within which positions belong to one crossing
MAX_OFF_STREET_SHARE = 0.4  # share of positions off any street, above which the capture has no streets
STEP_SCALES = (1.0, 1.5, 2.0, 3.0)  # times a step, at which streets are searched: parallel lanes are one street


def find_crossings(ground: Float[np.ndarray, "photograph 2"]) -> Float[np.ndarray, "crossing 2"]:
    """The middles of crossings and corners, seen from above; none where there are no streets, or they never meet.

    Both lanes of a street are one street only from a step on that is about as long as they are apart. So several are
    tried, and the one counts at which most streets meet, the finest of equals.
    """
    step = usual_step(ground)
    if step == 0:
        return np.zeros((0, 2))
    return max((crossings_at(ground, scale * step) for scale in STEP_SCALES), key=len)


def crossings_at(ground: Float[np.ndarray, "photograph 2"], step: float) -> Float[np.ndarray, "crossing 2"]:
    """Crossings and corners, as far as they show in places that are a step apart."""
    nodes = thinned(ground, step)
    tree = cKDTree(nodes)
    found = [ways(nodes[near] - node, step) for node, near in zip(nodes, near_by(tree, step), strict=True)]
    number, turns = np.array([n for n, _ in found]), np.array([widest > MIN_CORNER_ANGLE for _, widest in found])
    at = nodes[(number >= 3) | ((number == 2) & turns)]
    if not (number >= 3).any() or np.isin(number, (1, 2)).mean() < 1 - MAX_OFF_STREET_SHARE:
        return np.zeros((0, 2))
    pairs = cKDTree(at).query_pairs(CROSSING_RADIUS * step, output_type="ndarray")
    links = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(at), len(at)))
    count, label = connected_components(links, directed=False)
    return np.stack([at[label == i].mean(0) for i in range(count)])


def usual_step(ground: Float[np.ndarray, "photograph 2"]) -> float:
    """Distance from one place to the next along the way; 0 where all places are one."""
    if len(ground) < 3:
        return 0.0
    distance, index = cKDTree(ground).query(ground, min(GRAPH_NEIGHBOURS, len(ground)))
    rows = np.repeat(np.arange(len(ground)), distance.shape[1])
    shortest = np.maximum(distance.ravel(), 1e-12)  # what is 0 would be no way at all
    ways = minimum_spanning_tree(csr_matrix((shortest, (rows, index.ravel())), (len(ground), len(ground)))).data
    long = ways[ways > 1e-9]
    return float(np.quantile(long, STEP_QUANTILE)) if len(long) else 0.0


def thinned(ground: Float[np.ndarray, "photograph 2"], step: float) -> Float[np.ndarray, "node 2"]:
    """One place for all photographs within a square of a step."""
    _, cell = np.unique(np.floor(ground / step).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    return np.stack([np.bincount(cell, ground[:, k]) for k in range(2)], -1) / np.bincount(cell)[:, None]


def near_by(tree: cKDTree, step: float) -> list[Int[np.ndarray, " near"]]:
    return [np.array(near) for near in tree.query_ball_point(tree.data, OUTER_RADIUS * step)]


def ways(around: Float[np.ndarray, "near 2"], step: float) -> tuple[int, float]:
    """In how many directions streets leave the middle of these places, 0 where there are places all around or none;
    and the widest angle between two of them, radians."""
    far = around[np.linalg.norm(around, axis=-1) > INNER_RADIUS * step]
    if not len(far):
        return 0, 0.0
    angles = np.sort(np.arctan2(far[:, 1], far[:, 0]))
    gaps = np.diff(angles, append=angles[0] + 2 * np.pi)
    return int((gaps > MIN_STREET_ANGLE).sum()), float(gaps.max())
