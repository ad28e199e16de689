"""Overlap of photographs before reconstruction: number of matched features at a small size.

Features are SIFT (Lowe 2004) of the photograph at SIDE pixels, the largest COUNT of them. Two photographs share a
feature if each is the other's nearest in descriptor space, and at RATIO of the distance of the second nearest or less.
Chance alone gives up to 11 on a carpet's repeated pattern; neighbours of a walk around it share 20 to 170.
"""

import threading
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image

from ...readers.pictures import eight_bits

SIDE, COUNT = 480, 800  # pixels of the longer side; details of a photograph
RATIO = 0.8  # of the distances to the nearest and second nearest (Lowe 2004, section 7.1)
MIN_SHARED = 15  # details, below which two photographs do not count as neighbours

EXTRACTING = threading.Lock()  # COLMAP's extractor keeps its pyramid between calls

Descriptors = UInt8[np.ndarray, "_ 128"]  # of the details of a photograph


@cache
def extractor() -> Any:
    from ...system.library import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value  # else it announces itself on stderr
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.sift.max_num_features, options.sift.first_octave = COUNT, 0  # those of the largest scale
    return pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)


def details(image: Image.Image) -> Descriptors:
    """Descriptors of the largest features. Raises Pillow's errors for damaged files."""
    image.draft("L", (SIDE, SIDE))
    grey = eight_bits(image).convert("L")
    grey.thumbnail((SIDE, SIDE))
    with EXTRACTING:
        _, descriptors = extractor().extract_from_uint8_array(np.ascontiguousarray(grey))
    return np.array(descriptors.data, np.uint8).reshape(-1, 128)


def shared(one: Descriptors, other: Descriptors) -> int:
    """Number of features that two photographs share."""
    if min(len(one), len(other)) < 2:
        return 0
    similar = unit(one) @ unit(other).T
    (there, clear), (back, _) = nearest(similar), nearest(similar.T)
    return int((clear & (back[there] == np.arange(len(one)))).sum())


def unit(descriptors: Descriptors) -> Float[np.ndarray, "_ 128"]:
    vectors = descriptors.astype(np.float32)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)


def nearest(similar: Float[np.ndarray, "a b"]) -> tuple[Int[np.ndarray, " a"], Bool[np.ndarray, " a"]]:
    """Nearest of b for each of a, and a mask of those that pass the ratio test. similar: cosines"""
    first = similar.argmax(1)
    best = np.take_along_axis(similar, first[:, None], 1)[:, 0]
    second = np.partition(similar, -2, 1)[:, -2]
    return first, 1 - best <= RATIO**2 * (1 - second)  # |a - b|² = 2 - 2 cos


def apart(names: Sequence[str], count: Callable[[str, str], int]) -> list[str]:
    """Names of photographs with too little overlap with every other one.

    names: in the order of the walk: neighbours are compared first, the others only for photographs without a neighbour
    count: number of features that two photographs share
    """
    found = []
    for i, name in enumerate(names):
        others = sorted((j for j in range(len(names)) if j != i), key=lambda j: abs(j - i))
        if not any(count(name, names[j]) >= MIN_SHARED for j in others):
            found.append(name)
    return found
