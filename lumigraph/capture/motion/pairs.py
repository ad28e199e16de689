"""Which photographs to compare with which: all, neighbours in time, or those that look alike."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.cluster.vq import kmeans2, vq

from ...library import pycolmap

Matching = Literal["auto", "exhaustive", "sequential", "retrieval"]
Pair = tuple[int, int]

ALL_BELOW = 80  # photographs, of which every pair is compared
NEIGHBOURS = 10  # in order, on each side; beyond them those 16, 32, ... places away
ALIKE = 30  # photographs that each is compared with where not all can be
LOOPS = 5  # those of an ordered capture that look alike without being neighbours: where the camera came back
WORDS = 64  # of the vocabulary
SAMPLED = 500  # descriptors of each photograph that are looked at
LEARNT_FROM = 30_000  # of which the vocabulary is learnt
TILE = 16  # photographs whose features COLMAP keeps at hand: pairs are compared tile by tile


def choose_matching(count: int, in_order: bool) -> Matching:
    if in_order:
        return "sequential"
    return "exhaustive" if count <= ALL_BELOW else "retrieval"


def exhaustive(count: int) -> set[Pair]:
    return {(i, j) for j in range(count) for i in range(j)}


def sequential(count: int, neighbours: int = NEIGHBOURS) -> set[Pair]:
    """Pairs of photographs in order: nearby ones all, farther ones at distances that double."""
    steps = [*range(1, neighbours + 1), *(2**k for k in range(4, 10) if 2**k > neighbours)]
    return {(i, i + step) for step in steps for i in range(count - step)}


def alike(likeness: Float[np.ndarray, "photo photo"], most: int, apart: int = 1) -> set[Pair]:
    """Each photograph with the `most` that are most like it, among those at least `apart` places away."""
    count = len(likeness)
    places = np.arange(count)
    allowed = np.where(np.abs(places[:, None] - places) >= apart, likeness, -np.inf)
    order = np.argsort(-allowed, axis=1, kind="stable")[:, :most]
    return {(min(i, j), max(i, j)) for i in range(count) for j in order[i].tolist() if np.isfinite(allowed[i, j])}


def likeness(descriptors: Sequence[np.ndarray], seed: int = 0) -> Float[np.ndarray, "photo photo"]:
    """How alike photographs are, by their features: cosines between vectors of locally aggregated descriptors.

    VLAD (Jégou 2010) over a vocabulary that is learnt from the photographs themselves. For each word the residuals of
    the descriptors nearest to it are added up; each sum is normalised (Arandjelović 2013), then the whole.
    descriptors: of each photograph, (feature, 128)
    """
    chance = np.random.default_rng(seed)
    sampled = [d[chance.permutation(len(d))[:SAMPLED]].astype(np.float32) for d in descriptors]
    joined = np.concatenate(sampled)
    if len(joined) <= WORDS:
        return np.zeros((len(descriptors), len(descriptors)))
    learnt = joined[chance.permutation(len(joined))[:LEARNT_FROM]]
    words, _ = kmeans2(learnt, WORDS, iter=10, minit="++", seed=seed)
    vectors = np.zeros((len(sampled), WORDS, joined.shape[1]))
    for vector, found in zip(vectors, sampled, strict=True):
        if len(found):
            nearest, _ = vq(found, words)
            np.add.at(vector, nearest, found - words[nearest])
    vectors /= np.linalg.norm(vectors, axis=2, keepdims=True).clip(1e-9)
    flat = vectors.reshape(len(sampled), -1)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True).clip(1e-9)
    return flat @ flat.T


def near(positions: Float[np.ndarray, "photo 3"], most: int = NEIGHBOURS) -> set[Pair]:
    """Each photograph with the `most` taken nearest to it; NaN where nobody knows."""
    distance = np.linalg.norm(positions[:, None] - positions, axis=-1)
    return alike(-np.nan_to_num(distance, nan=np.inf), most)


def choose_pairs(
    matching: Matching, names: Sequence[str], database: Path, positions: Float[np.ndarray, "photo 3"]
) -> list[Pair]:
    """The pairs to compare, by number, in an order that asks for few photographs' features at a time.

    names:     in order of exposure or by name
    database:  COLMAP's, with features; looked into only where likeness matters
    positions: by GPS, in metres; NaN where unknown
    """
    count = len(names)
    if matching == "exhaustive" or count <= NEIGHBOURS:
        pairs = exhaustive(count)
    else:
        similar = likeness(read_descriptors(database, names))
        if matching == "sequential":
            pairs = sequential(count) | alike(similar, LOOPS, apart=NEIGHBOURS + 1)
        else:
            pairs = sequential(count, 2) | alike(similar, ALIKE) | near(positions)
    return sorted(pairs, key=lambda pair: (pair[1] // TILE, pair[0] // TILE, pair))


def read_descriptors(database: Path, names: Sequence[str]) -> list[np.ndarray]:
    opened = pycolmap.Database.open(database)
    try:
        numbers = {image.name: image.image_id for image in opened.read_all_images()}
        return [opened.read_descriptors(numbers[name]).data for name in names]
    finally:
        opened.close()
