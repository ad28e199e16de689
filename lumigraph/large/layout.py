"""Layout of blocks, and the photographs that each learns from (Tancik 2022, section 3 and 4.1).

A block is a disc on the ground. Centres are at crossings, for photographs along streets that meet; otherwise by
k-means. Each photograph belongs to its nearest centre, and a block's radius is 4/3 of its cell's extent: to the
farthest of its photographs, and half-way to the next centre. Two neighbours then overlap by half a radius.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from ..errors import LumigraphError, LumigraphWarning
from ..files import read_json
from ..files.ranges import Point, Positive, typed
from ..readers import Places
from .plan import Block

MIN_LARGE_VIEWS = 200  # photographs from which on a capture is divided by default
VIEWS_PER_BLOCK = 64  # approximate
MIN_CROSSING_VIEWS = 16  # mean number of photographs in a cell at a crossing; with fewer, crossings are not used
OVERLAP_FACTOR = 4 / 3  # radius of a block relative to the radius of its cell
NEAR_RADII, FACING_COSINE = 1.25, 0.7  # a photograph that faces the block counts within so many radii; least cosine
SPLIT_FACTOR = 2.0  # times the usual radius of a cell, from which on it is split
MAX_BLOCKS = 100_000  # blocks
KMEANS_ROUNDS = 50  # of k-means
GRAPH_NEIGHBOURS = 12  # candidate positions for the way to the next one
STEP_QUANTILE = 0.9  # of the spanning tree's edges; rigs take many photographs at one place
INNER_RADIUS, OUTER_RADIUS = 1.5, 3.5  # steps around a position, between which outgoing streets are counted
MIN_STREET_ANGLE = np.radians(45)  # between two streets
MIN_CORNER_ANGLE = np.radians(225)  # of the outer side of a corner
CROSSING_RADIUS = 2.5  # steps within which positions belong to one crossing
MAX_OFF_STREET_SHARE = 0.4  # share of positions off any street, above which the capture has no streets
STEP_SCALES = (1.0, 1.5, 2.0, 3.0)  # times a step, at which streets are searched: parallel lanes are one street


@dataclass(frozen=True)
class Disc:
    """A block in a file, in the source's frame and units."""

    centre: Point
    radius: Positive


@dataclass(frozen=True)
class Discs:
    """A block file; a run's blocks.json is one too."""

    blocks: list[Disc]


def lay_out(places: Places, wish: str | Path = "auto", source: str = "the capture") -> list[Block]:
    """Blocks of a capture, each with at least two training photographs.

    wish:   "auto", a number, or a file with `Discs`
    source: named in faults
    Smaller blocks are left out and named in a LumigraphWarning, as is the number of training photographs outside all
    blocks. Raises LumigraphError for a number that exceeds the places, an invalid file, and one whose blocks are all
    elsewhere.
    """
    from_file = not (str(wish) == "auto" or str(wish).isdigit())
    if not from_file:
        found = discs(places, None if str(wish) == "auto" else int(str(wish)))
    else:
        path = Path(wish)
        if not path.exists():
            raise LumigraphError(f"--blocks {wish} is no number and no file; give auto, a number of blocks, or a file")
        found = typed(Discs, read_json(path), path).blocks
    middles = np.array([disc.centre for disc in found]).reshape(-1, 3) @ places.upright.T
    owner = cells(places.ground, middles[:, :2]) if len(found) else np.zeros(0, int)
    blocks, empty, seen = [], [], np.zeros(len(places), bool)
    learnt = np.array([split == "train" for split in places.splits])
    for number, disc in enumerate(found):
        chosen = members(places, disc)
        if not from_file:
            chosen |= owner == number
        if (chosen & learnt).sum() < 2:
            empty.append(str(number))
            continue
        seen |= chosen
        names = [places.names[i] for i in np.flatnonzero(chosen)]
        blocks.append(Block(str(number), disc.centre, disc.radius, names))
    if not blocks:
        raise LumigraphError(
            f"No block of {wish} has two photographs of {source} to learn from; its blocks are elsewhere, so correct "
            "their centres, which are in the frame of the photographs"
        )
    if empty:
        verb = "block has" if len(empty) == 1 else "blocks have"
        message = f"{len(empty)} {verb} fewer than two photographs to learn from and will not be trained: "
        message += f"{', '.join(empty[:20])}{' ...' if len(empty) > 20 else ''}"
        warnings.warn(message, LumigraphWarning, 2)
    if lost := int((~seen & learnt).sum()):
        message = f"{lost} photographs to learn from are in no block, and nothing learns from them"
        warnings.warn(message, LumigraphWarning, 2)
    return blocks


def discs(places: Places, number: int | None) -> list[Disc]:
    """Discs that cover every photograph; None chooses their number."""
    ground = places.ground
    centres = spread(ground, number) if number else centres_for(ground)
    owner = cells(ground, centres)
    reach = reaches(ground, centres, owner)
    if len(centres) > 1:  # cells touch half-way, also where no photograph is
        reach = np.maximum(reach, 0.5 * cKDTree(centres).query(centres, 2)[0][:, 1])
    least = 1e-3 * max(float(np.ptp(ground, axis=0).max()), 1e-6)  # a place where all photographs were taken at
    heights = (places.positions @ places.upright.T)[:, 2]
    made = []
    for i, (x, y) in enumerate(centres):
        height = float(heights[owner == i].mean()) if (owner == i).any() else float(heights.mean())
        a, b, c = (np.array([x, y, height]) @ places.upright).tolist()
        made.append(Disc((a, b, c), max(OVERLAP_FACTOR * float(reach[i]), least)))
    return made


def centres_for(ground: Float[np.ndarray, "photograph 2"]) -> Float[np.ndarray, "block 2"]:
    """Centres at crossings, and more where streets reach far beyond them; by k-means without streets that meet."""
    centres = find_crossings(ground)
    if len(centres) < 2 or len(ground) < MIN_CROSSING_VIEWS * len(centres):
        return spread(ground, max(1, round(len(ground) / VIEWS_PER_BLOCK)))
    while True:
        owner = cells(ground, centres)
        reach = reaches(ground, centres, owner)
        worst = int(reach.argmax())
        if reach[worst] <= SPLIT_FACTOR * np.median(reach) or len(ground) < MIN_CROSSING_VIEWS * (len(centres) + 1):
            return centres
        own = ground[owner == worst]
        away = np.linalg.norm(own - centres[worst], axis=-1)
        centres = np.concatenate([centres, own[away > 0.5 * reach[worst]].mean(0, keepdims=True)])
        if len(np.unique(cells(ground, centres))) < len(centres):
            return centres[:-1]


def spread(ground: Float[np.ndarray, "photograph 2"], number: int) -> Float[np.ndarray, "block 2"]:
    """`number` centres by k-means from farthest-point initialisation, sorted by y, then x. Deterministic."""
    there = np.unique(ground.round(9), axis=0)
    if number > min(len(there), MAX_BLOCKS):
        raise LumigraphError(
            f"{number} blocks are too many for photographs from {len(there)} places; give --blocks a smaller number"
        )
    first = [int(np.linalg.norm(there - there.mean(0), axis=-1).argmax())]
    nearest = np.linalg.norm(there - there[first[0]], axis=-1)
    while len(first) < number:
        first.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(there - there[first[-1]], axis=-1))
    centres = there[first]
    for _ in range(KMEANS_ROUNDS):
        owner = cells(ground, centres)
        count = np.bincount(owner, minlength=number)
        sums = np.stack([np.bincount(owner, ground[:, k], number) for k in range(2)], -1)
        moved = np.where(count[:, None] > 0, sums / np.maximum(count, 1)[:, None], centres)
        if np.allclose(moved, centres):
            break
        centres = moved
    return centres[np.lexsort((centres[:, 0], centres[:, 1]))]


def cells(
    ground: Float[np.ndarray, "photograph 2"], centres: Float[np.ndarray, "block 2"]
) -> Int[np.ndarray, " photograph"]:
    """The number of the centre nearest to each photograph."""
    return cKDTree(centres).query(ground)[1].astype(np.int64)


def members(places: Places, disc: Disc) -> Bool[np.ndarray, " photograph"]:
    """Mask of the photographs of a block: those within its radius, and nearby ones that look at it."""
    way = np.array(disc.centre) - places.positions
    flat = np.linalg.norm((way @ places.upright.T)[:, :2], axis=-1)
    towards = (way * places.forwards).sum(-1) > FACING_COSINE * np.linalg.norm(way, axis=-1)
    return (flat <= disc.radius) | (towards & (flat <= NEAR_RADII * disc.radius))


def reaches(
    ground: Float[np.ndarray, "photograph 2"],
    centres: Float[np.ndarray, "block 2"],
    owner: Int[np.ndarray, " photograph"],
) -> Float[np.ndarray, " block"]:
    """Distance of each centre to the farthest photograph of its cell; 0 for an empty one."""
    reach = np.zeros(len(centres))
    np.maximum.at(reach, owner, np.linalg.norm(ground - centres[owner], axis=-1))
    return reach


def find_crossings(ground: Float[np.ndarray, "photograph 2"]) -> Float[np.ndarray, "crossing 2"]:
    """Centres of crossings and corners on the ground; none without streets that meet.

    The lanes of a street merge only at a step about as long as their distance. So several steps are tried; the one with
    most crossings is used, the finest of equals.
    """
    step = usual_step(ground)
    if step == 0:
        return np.zeros((0, 2))
    return max((crossings_at(ground, scale * step) for scale in STEP_SCALES), key=len)


def crossings_at(ground: Float[np.ndarray, "photograph 2"], step: float) -> Float[np.ndarray, "crossing 2"]:
    """Crossings and corners in places thinned to a step."""
    nodes = thinned(ground, step)
    near = cKDTree(nodes).query_ball_point(nodes, OUTER_RADIUS * step)
    found = [ways(nodes[some] - node, step) for node, some in zip(nodes, near, strict=True)]
    number, turns = np.array([n for n, _ in found]), np.array([widest > MIN_CORNER_ANGLE for _, widest in found])
    at = nodes[(number >= 3) | ((number == 2) & turns)]
    if not (number >= 3).any() or np.isin(number, (1, 2)).mean() < 1 - MAX_OFF_STREET_SHARE:
        return np.zeros((0, 2))
    pairs = cKDTree(at).query_pairs(CROSSING_RADIUS * step, output_type="ndarray")
    links = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(at), len(at)))
    count, label = connected_components(links, directed=False)
    return np.stack([at[label == i].mean(0) for i in range(count)])


def usual_step(ground: Float[np.ndarray, "photograph 2"]) -> float:
    """Typical distance of neighbouring photographs, a quantile of spanning tree edges; 0 for a single place."""
    if len(ground) < 3:
        return 0.0
    distance, index = cKDTree(ground).query(ground, min(GRAPH_NEIGHBOURS, len(ground)))
    rows = np.repeat(np.arange(len(ground)), distance.shape[1])
    shortest = np.maximum(distance.ravel(), 1e-12)  # what is 0 would be no way at all
    ways = minimum_spanning_tree(csr_matrix((shortest, (rows, index.ravel())), (len(ground), len(ground)))).data
    long = ways[ways > 1e-9]
    return float(np.quantile(long, STEP_QUANTILE)) if len(long) else 0.0


def thinned(ground: Float[np.ndarray, "photograph 2"], step: float) -> Float[np.ndarray, "node 2"]:
    """One place for all photographs within a grid square of a step."""
    _, cell = np.unique(np.floor(ground / step).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    return np.stack([np.bincount(cell, ground[:, k]) for k in range(2)], -1) / np.bincount(cell)[:, None]


def ways(around: Float[np.ndarray, "near 2"], step: float) -> tuple[int, float]:
    """Number of directions in which streets leave the middle of these places, 0 for places all around or none; and the
    widest angle between two of them, radians."""
    far = around[np.linalg.norm(around, axis=-1) > INNER_RADIUS * step]
    if not len(far):
        return 0, 0.0
    angles = np.sort(np.arctan2(far[:, 1], far[:, 0]))
    gaps = np.diff(angles, append=angles[0] + 2 * np.pi)
    return int((gaps > MIN_STREET_ANGLE).sum()), float(gaps.max())
