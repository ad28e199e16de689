"""Overlap of photographs before cameras are looked for: details at a small size that two of them share.

Details are SIFT features (Lowe 2004) of the photograph at SIDE pixels, the largest COUNT of them. Two photographs share
a detail if each is the other's nearest in descriptor space, and at RATIO of the distance of the second nearest or less.
Chance alone gives up to 11 on the bananas of a carpet; neighbours of a walk around them share 20 to 170.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from PIL import Image

from ..pictures import eight_bits

SIDE, COUNT = 480, 800  # pixels of the longer side; details of a photograph
RATIO = 0.8  # of the distances to the nearest and second nearest (Lowe 2004, section 7.1)
MIN_SHARED = 15  # details, below which two photographs do not count as neighbours
NEIGHBOURS = 2  # photographs before and after, which are compared first

Descriptors = Float[np.ndarray, "_ 128"]  # of the details of a photograph


@cache
def extractor() -> Any:
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value  # else it announces itself on stderr
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.sift.max_num_features, options.sift.first_octave = COUNT, 0  # those of the largest scale
    return pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)


def details(image: Image.Image) -> Descriptors:
    """Unit descriptors of the largest details. Raises whatever Pillow raises for damaged files."""
    image.draft("L", (SIDE, SIDE))
    grey = eight_bits(image).convert("L")
    grey.thumbnail((SIDE, SIDE))
    _, descriptors = extractor().extract_from_uint8_array(np.ascontiguousarray(grey))
    chosen = np.asarray(descriptors.data, np.float32).reshape(-1, 128)
    return chosen / np.maximum(np.linalg.norm(chosen, axis=1, keepdims=True), 1e-9)


def shared(one: Descriptors, other: Descriptors) -> int:
    """Number of details that two photographs share."""
    if min(len(one), len(other)) < 2:
        return 0
    similar = one @ other.T
    (there, clear), (back, _) = nearest(similar), nearest(similar.T)
    return int((clear & (back[there] == np.arange(len(one)))).sum())


def nearest(similar: Float[np.ndarray, "a b"]) -> tuple[Int[np.ndarray, " a"], Bool[np.ndarray, " a"]]:
    """Nearest of b for each of a, and whether it is much nearer than the second. similar: cosines"""
    first = similar.argmax(1)
    best = np.take_along_axis(similar, first[:, None], 1)[:, 0]
    second = np.partition(similar, -2, 1)[:, -2]
    return first, 1 - best <= RATIO**2 * (1 - second)  # |a - b|² = 2 - 2 cos


def apart(descriptors: Mapping[str, Descriptors]) -> list[str]:
    """Names of photographs that share too little with every other one; given in the order of the walk.

    Neighbours in order are compared first, and the others only for photographs without a neighbour.
    """
    names = list(descriptors)
    found = []
    for i, name in enumerate(names):
        near = [j for k in range(1, NEIGHBOURS + 1) for j in (i - k, i + k) if 0 <= j < len(names)]
        rest = [j for j in range(len(names)) if j != i and j not in near]
        if not any(shared(descriptors[name], descriptors[names[j]]) >= MIN_SHARED for j in [*near, *rest]):
            found.append(name)
    return found
