"""Pairs of photographs to match: all, neighbours in time, or similar ones."""

from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.cluster.vq import kmeans2, vq
from scipy.spatial import cKDTree

from ..geometry import evenly
from ..system.library import pycolmap

Matching = Literal["auto", "exhaustive", "sequential", "retrieval"]
Pair = tuple[int, int]

MAX_EXHAUSTIVE_VIEWS = 80  # photographs, of which every pair is compared
SEQUENTIAL_NEIGHBOURS = 10  # in order, on each side; beyond them those 16, 32, ... places away
RETRIEVED_VIEWS = 30  # similar photographs compared with each one in large captures
LOOP_CANDIDATES = 5  # similar photographs far apart in an ordered capture, for loop closure
VOCABULARY_SIZE = 64  # of the vocabulary
SAMPLED_DESCRIPTORS = 500  # per photograph
VOCABULARY_VIEWS = 240  # photographs from which the vocabulary is learnt
VOCABULARY_DESCRIPTORS = 30_000  # descriptors from which the vocabulary is learnt
BLOCK_VIEWS = 256  # photographs compared with all others at a time
LOOK_FEATURES = 500  # largest features of each photograph in a first look at a pair
LOOK_RATIO = 0.8  # of the distances to the best and the second-best feature (Lowe 2004, section 7.1)
MIN_LOOK_MATCHES = 4  # matches of a first look, with which all features of a pair are compared
LOOK_VIEWS = 8  # photographs with the most such matches, with which each one is compared in any case
TILE_VIEWS = 16  # photographs whose features COLMAP keeps in memory: pairs are compared tile by tile


def choose_matching(count: int, in_order: bool) -> Matching:
    if in_order:
        return "sequential"
    return "exhaustive" if count <= MAX_EXHAUSTIVE_VIEWS else "retrieval"


def exhaustive(count: int) -> set[Pair]:
    return {(i, j) for j in range(count) for i in range(j)}


def sequential(count: int, neighbours: int = SEQUENTIAL_NEIGHBOURS) -> set[Pair]:
    """Pairs of photographs in order: nearby ones all, farther ones at distances that double."""
    steps = [*range(1, neighbours + 1), *(2**k for k in range(4, 10) if 2**k > neighbours)]
    return {(i, i + step) for step in steps for i in range(count - step)}


def alike(vectors: Float[np.ndarray, "photo number"], most: int, apart: int = 1) -> set[Pair]:
    """Pairs of each photograph with the `most` most similar ones, among those at least `apart` places away.

    vectors: of each, see `aggregated`
    """
    places, pairs = np.arange(len(vectors)), set()
    for block in np.split(places, range(BLOCK_VIEWS, len(places), BLOCK_VIEWS)):
        likeness = vectors[block] @ vectors.T
        likeness[np.abs(block[:, None] - places) < apart] = -np.inf
        order = np.argsort(-likeness, axis=1, kind="stable")[:, :most]
        found = np.isfinite(np.take_along_axis(likeness, order, 1))
        pairs |= {
            (min(i, j), max(i, j))
            for i, row, there in zip(block.tolist(), order.tolist(), found.tolist(), strict=True)
            for j, is_one in zip(row, there, strict=True)
            if is_one
        }
    return pairs


def overlapping(largest: Sequence[Float[np.ndarray, "feature 128"]]) -> set[Pair]:
    """Pairs that share some of their largest features (preemptive matching: Wu 2013, section 3.1), and of each
    photograph those that share most.

    largest: descriptors of each photograph's largest features, of unit length
    """
    shared = np.zeros((len(largest), len(largest)))
    for i, j in exhaustive(len(largest)):
        shared[i, j] = shared[j, i] = shared_features(largest[i], largest[j])
    most = np.argsort(-shared, axis=1, kind="stable")[:, :LOOK_VIEWS]
    np.put_along_axis(shared, most, np.inf, 1)
    return {(min(i, j), max(i, j)) for i, j in np.argwhere(shared >= MIN_LOOK_MATCHES).tolist() if i != j}


def shared_features(first: Float[np.ndarray, "a 128"], second: Float[np.ndarray, "b 128"]) -> int:
    """Number of mutual nearest descriptors, of unit length, that pass the ratio test."""
    if min(len(first), len(second)) < 2:
        return 0
    alike = first @ second.T
    rows, best, most = np.arange(len(first)), alike.argmax(1), alike.max(0)
    found = alike[rows, best]
    alike[rows, best] = -1.0
    return int(np.count_nonzero((found == most[best]) & (1 - found < LOOK_RATIO**2 * (1 - alike.max(1)))))


def largest_features(database: pycolmap.Database, image: int) -> Float[np.ndarray, "feature 128"]:
    """Descriptors of an image's largest features, of unit length."""
    places, found = database.read_keypoints(image), database.read_descriptors(image).data
    size = np.abs(places[:, 2] * places[:, 5] - places[:, 3] * places[:, 4]) if places.shape[1] > 4 else places[:, 2]
    chosen = found[np.argsort(-size, kind="stable")[:LOOK_FEATURES]].astype(np.float32)
    return chosen / np.linalg.norm(chosen, axis=1, keepdims=True).clip(1e-9)


def aggregated(
    descriptors: Callable[[int], np.ndarray], count: int, seed: int = 0
) -> Float[np.ndarray, "photo number"]:
    """Global descriptor of each photograph (VLAD); the product of two is their similarity, 1 at most.

    VLAD (Jégou 2010) over a vocabulary learnt from the photographs themselves: sums over each word of the residuals of
    its nearest descriptors; each sum is normalised (Arandjelović 2013), then the whole.
    descriptors: reads those of a photograph, (feature, 128); called twice for each
    """

    def sampled(photo: int) -> np.ndarray:
        found = descriptors(photo)
        order = np.random.default_rng([seed, photo]).permutation(len(found))
        return found[order[:SAMPLED_DESCRIPTORS]].astype(np.float32)

    joined = np.concatenate([sampled(photo) for photo in evenly(range(count), VOCABULARY_VIEWS)])
    if len(joined) <= VOCABULARY_SIZE:
        return np.zeros((count, 1), np.float32)
    learnt = joined[np.random.default_rng(seed).permutation(len(joined))[:VOCABULARY_DESCRIPTORS]]
    words, _ = kmeans2(learnt, VOCABULARY_SIZE, iter=10, minit="++", seed=seed)
    vectors = np.zeros((count, VOCABULARY_SIZE, joined.shape[1]), np.float32)
    for photo, vector in enumerate(vectors):
        if len(found := sampled(photo)):
            nearest, _ = vq(found, words)
            np.add.at(vector, nearest, found - words[nearest])
        vector /= np.linalg.norm(vector, axis=1, keepdims=True).clip(1e-9)
        vector /= np.linalg.norm(vector).clip(1e-9)
    return vectors.reshape(len(vectors), -1)


def near(positions: Float[np.ndarray, "photo 3"], most: int = SEQUENTIAL_NEIGHBOURS) -> set[Pair]:
    """Pairs of each photograph with the `most` nearest ones; NaN for unknown positions."""
    known = np.flatnonzero(np.isfinite(positions).all(1))
    if len(known) < 2:
        return set()
    _, found = cKDTree(positions[known]).query(positions[known], k=min(most + 1, len(known)))
    pairs = {(i, j) for i, row in zip(known.tolist(), known[found].tolist(), strict=True) for j in row if i != j}
    return {(min(pair), max(pair)) for pair in pairs}


def choose_pairs(
    matching: Matching,
    names: Sequence[str],
    database: Path,
    positions: Float[np.ndarray, "photo 3"],
    preempt: bool = True,
) -> list[Pair]:
    """Pairs to match, by number, in an order that needs few photographs' features at a time.

    names:     in order of exposure or by name
    database:  COLMAP's, with features; read only for similarity
    positions: by GPS, in metres; NaN where unknown
    preempt:   leave pairs that share none of their largest features out of exhaustive matching
    """
    count = len(names)
    if (all_pairs := matching == "exhaustive" or count <= SEQUENTIAL_NEIGHBOURS) and not preempt:
        pairs = exhaustive(count)
    else:
        with closing(pycolmap.Database.open(database)) as opened:
            number = {image.name: image.image_id for image in opened.read_all_images()}
            if all_pairs:
                return in_tiles(
                    sequential(count, 2) | overlapping([largest_features(opened, number[n]) for n in names])
                )
            similar = aggregated(lambda photo: opened.read_descriptors(number[names[photo]]).data, count)
        if matching == "sequential":
            pairs = sequential(count) | alike(similar, LOOP_CANDIDATES, apart=SEQUENTIAL_NEIGHBOURS + 1)
        else:
            pairs = sequential(count, 2) | alike(similar, RETRIEVED_VIEWS) | near(positions)
    return in_tiles(pairs)


def in_tiles(pairs: set[Pair]) -> list[Pair]:
    return sorted(pairs, key=lambda pair: (pair[1] // TILE_VIEWS, pair[0] // TILE_VIEWS, pair))
