"""The numbers that many numbers are rounded to with the least squared error: a codebook of scalars."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

LEVEL_COUNT = 256  # of levels, one for each byte
PASSES = 12


def levels(values: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, " level"]:
    """256 numbers in rising order, to which `values` are to be rounded; values of fewer kinds stay what they are.

    The best levels lie as densely as the cube root of the values' density (Panter and Dite 1951). Between neighbours a
    gap apart, who occur c times, that is c / gap, so (c / gap)^(1/3) gap of a level belongs there. They begin so, and
    each then moves to the mean of what is nearest to it (Lloyd 1982).
    """
    values = np.sort(values.astype(np.float64), axis=None)
    kinds, counts = np.unique(values, return_counts=True)
    if len(kinds) <= LEVEL_COUNT:
        return np.pad(kinds, (0, LEVEL_COUNT - len(kinds)), mode="edge")
    parts = np.cbrt((counts[1:] + counts[:-1]) / 2 * np.diff(kinds) ** 2)
    shares = np.concatenate([[0], np.cumsum(parts)])
    book = np.interp((np.arange(LEVEL_COUNT) + 0.5) / LEVEL_COUNT * shares[-1], shares, kinds)
    sums = np.concatenate([[0], np.cumsum(values)])
    for _ in range(PASSES):
        ends = np.searchsorted(values, [-np.inf, *(book[1:] + book[:-1]) / 2, np.inf])
        held = np.diff(ends)
        book = np.where(held > 0, np.diff(sums[ends]) / np.maximum(held, 1), book)
    return book


def nearest_level(
    values: Float[np.ndarray, "*shape"], book: Float[np.ndarray, " level"]
) -> UInt8[np.ndarray, "*shape"]:
    """The index of the level nearest to each value."""
    return np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8)
