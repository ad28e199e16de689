"""Layout of blocks, and the photographs that each learns from (Tancik 2022, section 3 and 4.1).

A block is a disc on the ground. At crossings, where photographs were taken along streets that meet; otherwise where
k-means puts so many of them. Each photograph is nearest to one centre, and a block's radius is 4/3 of how far its
cell goes: to the farthest of those, and half-way to the next centre. Two neighbours then overlap by half a radius.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from ..capture import Places
from ..errors import LumigraphError, LumigraphWarning
from ..files import read_json
from ..files.ranges import Point, Positive, typed
from .crossings import find_crossings
from .plan import Block

MIN_LARGE_VIEWS = 200  # photographs from which on a capture is divided by default
VIEWS_PER_BLOCK = 64  # approximate
MIN_CROSSING_VIEWS = 16  # mean number of photographs in a cell at a crossing; with fewer, crossings are not used
OVERLAP_FACTOR = 4 / 3  # radius of a block relative to the radius of its cell
NEAR_RADII, FACING_COSINE = (
    1.25,
    0.7,
)  # radii within which a photograph that faces the block counts; minimum cosine of its direction
SPLIT_FACTOR = 2.0  # times the usual radius of a cell, from which on it is split
MAX_BLOCKS = 100_000  # blocks
KMEANS_ROUNDS = 50  # of k-means


@dataclass(frozen=True)
class Disc:
    """A block as a file says it: in the source's frame and units."""

    centre: Point
    radius: Positive


@dataclass(frozen=True)
class Discs:
    """A block file; a run's blocks.json is one too."""

    blocks: list[Disc]


def lay_out(places: Places, wish: str | Path = "auto", source: str = "the capture") -> list[Block]:
    """The blocks of a capture, each with at least one photograph to learn from.

    wish:   "auto", a number, or a file with `Discs`
    source: what to name
    Blocks that no photograph is of are left out, and named in a LumigraphWarning; so is how many photographs are of no
    block. Raises LumigraphError for a number that there are too few places for, a file that is none, and one whose
    blocks are all elsewhere.
    """
    if str(wish) == "auto" or str(wish).isdigit():
        found = discs(places, None if str(wish) == "auto" else int(str(wish)))
    else:
        path = Path(wish)
        if not path.exists():
            raise LumigraphError(f"--blocks {wish} is no number and no file; give auto, a number of blocks, or a file")
        found = typed(Discs, read_json(path), path).blocks
    owner = cells(places.ground, ground_of(places, found)) if len(found) else np.zeros(0, int)
    blocks, empty, seen = [], [], np.zeros(len(places), bool)
    learnt = np.array([split == "train" for split in places.splits])
    for number, disc in enumerate(found):
        chosen = members(places, disc)
        if str(wish) == "auto" or str(wish).isdigit():
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
    tell(empty, int((~seen & learnt).sum()))
    return blocks


def tell(empty: Sequence[str], lost: int) -> None:
    if empty:
        verb = "block has" if len(empty) == 1 else "blocks have"
        warnings.warn(
            f"{len(empty)} {verb} fewer than two photographs to learn from and will not be trained: "
            f"{', '.join(empty[:20])}{' ...' if len(empty) > 20 else ''}",
            LumigraphWarning,
            3,
        )
    if lost:
        warnings.warn(
            f"{lost} photographs to learn from are in no block, and nothing learns from them", LumigraphWarning, 3
        )


def discs(places: Places, number: int | None) -> list[Disc]:
    """Discs that hold every photograph, as many as asked for; None for as many as suits."""
    ground = places.ground
    centres = spread(ground, number) if number else centres_for(ground)
    owner = cells(ground, centres)
    reach = np.array([farthest(ground[owner == i], centre) for i, centre in enumerate(centres)])
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
    """Crossings, and more where streets go far beyond them; k-means where there are no such streets."""
    centres = find_crossings(ground)
    if len(centres) < 2 or len(ground) < MIN_CROSSING_VIEWS * len(centres):
        return spread(ground, max(1, round(len(ground) / VIEWS_PER_BLOCK)))
    while True:
        owner = cells(ground, centres)
        reach = np.array([farthest(ground[owner == i], centre) for i, centre in enumerate(centres)])
        worst = int(reach.argmax())
        if reach[worst] <= SPLIT_FACTOR * np.median(reach) or len(ground) < MIN_CROSSING_VIEWS * (len(centres) + 1):
            return centres
        own = ground[owner == worst]
        away = np.linalg.norm(own - centres[worst], axis=-1)
        centres = np.concatenate([centres, own[away > 0.5 * reach[worst]].mean(0, keepdims=True)])
        if len(np.unique(cells(ground, centres))) < len(centres):
            return centres[:-1]


def spread(ground: Float[np.ndarray, "photograph 2"], number: int) -> Float[np.ndarray, "block 2"]:
    """So many centres by k-means, from places as far apart as can be; by y, then by x. Nothing is random."""
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
    """Mask of the photographs of a block: those taken within its radius, and those from near by that look at it."""
    way = np.array(disc.centre) - places.positions
    flat = np.linalg.norm((way @ places.upright.T)[:, :2], axis=-1)
    towards = (way * places.forwards).sum(-1) > FACING_COSINE * np.linalg.norm(way, axis=-1)
    return (flat <= disc.radius) | (towards & (flat <= NEAR_RADII * disc.radius))


def ground_of(places: Places, found: Sequence[Disc]) -> Float[np.ndarray, "block 2"]:
    return (np.array([disc.centre for disc in found]) @ places.upright.T)[:, :2]


def farthest(ground: Float[np.ndarray, "photograph 2"], centre: Float[np.ndarray, " 2"]) -> float:
    return float(np.linalg.norm(ground - centre, axis=-1).max()) if len(ground) else 0.0
