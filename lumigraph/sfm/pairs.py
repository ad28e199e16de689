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
LOOK_FEATURES = 300  # largest features of each photograph in a first look at all pairs
LOOK_VIEWS = 12  # photographs that share most of them with each one, which it is compared with
MIN_SHARED = 250  # features that these share with it, all together, below which it is compared with all photographs
MIN_LOOK_FEATURES = 2500  # of a photograph (mean), below which all pairs cost little, and poor photographs need them
LOOK_RATIO = 0.8  # of the distances to the best and the second-best feature (Lowe 2004, section 7.1)
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


def overlapping(largest: Float[np.ndarray, "photo feature 128"]) -> set[Pair]:
    """Pairs of each photograph with the LOOK_VIEWS ones that share most of its largest features (preemptive matching:
    Wu 2013, section 3.1): mutual nearest descriptors that pass the ratio test. One that shares few is paired with all.

    largest: descriptors of each photograph's largest features, of unit length; zero for none
    """
    shared = np.zeros((len(largest), len(largest)))
    for photo in range(1, len(largest)):
        alike = np.tensordot(largest[photo], largest[:photo], (1, 2))  # own feature, other photograph, its feature
        best, mutual = alike.argmax(2)[..., None], alike.max(0)[None]
        found = np.take_along_axis(alike, best, 2)
        mutual = np.take_along_axis(mutual, best.transpose(2, 1, 0), 2).transpose(2, 1, 0) == found
        np.put_along_axis(alike, best, -1.0, 2)
        clear = 1 - found[..., 0] < LOOK_RATIO**2 * (1 - alike.max(2))
        shared[photo, :photo] = shared[:photo, photo] = np.count_nonzero(mutual[..., 0] & clear, axis=0)
    np.fill_diagonal(shared, -1)
    most = np.argsort(-shared, axis=1, kind="stable")[:, :LOOK_VIEWS]
    poor = np.take_along_axis(shared, most, 1).sum(1) < MIN_SHARED
    pairs = {(min(i, j), max(i, j)) for i, row in enumerate(most.tolist()) for j in row}
    return pairs | {(i, j) for i, j in exhaustive(len(largest)) if poor[i] or poor[j]}


def largest_features(database: pycolmap.Database, image: int) -> Float[np.ndarray, "feature 128"]:
    """Descriptors of an image's largest features, of unit length; zero where there are fewer than LOOK_FEATURES."""
    (_, _, a, b, c, d), found = database.read_keypoints(image).T, database.read_descriptors(image).data
    chosen = found[np.argsort(-np.abs(a * d - b * c), kind="stable")[:LOOK_FEATURES]].astype(np.float32)
    chosen /= np.linalg.norm(chosen, axis=1, keepdims=True).clip(1e-9)
    return np.pad(chosen, ((0, LOOK_FEATURES - len(chosen)), (0, 0)))


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
    preempt:   of all pairs, take only those that share most of their largest features, where there are many features
    """
    count = len(names)
    exhaustively = matching == "exhaustive" or count <= SEQUENTIAL_NEIGHBOURS
    if exhaustively and (count <= LOOK_VIEWS or not preempt):
        return in_tiles(exhaustive(count))
    with closing(pycolmap.Database.open(database)) as opened:
        number = {image.name: image.image_id for image in opened.read_all_images()}
        if exhaustively and opened.num_descriptors() < MIN_LOOK_FEATURES * count:
            return in_tiles(exhaustive(count))
        if exhaustively:
            largest = np.stack([largest_features(opened, number[name]) for name in names])
            return in_tiles(sequential(count, 2) | overlapping(largest))
        similar = aggregated(lambda photo: opened.read_descriptors(number[names[photo]]).data, count)
    if matching == "sequential":
        return in_tiles(sequential(count) | alike(similar, LOOP_CANDIDATES, apart=SEQUENTIAL_NEIGHBOURS + 1))
    return in_tiles(sequential(count, 2) | alike(similar, RETRIEVED_VIEWS) | near(positions))


def in_tiles(pairs: set[Pair]) -> list[Pair]:
    return sorted(pairs, key=lambda pair: (pair[1] // TILE_VIEWS, pair[0] // TILE_VIEWS, pair))
