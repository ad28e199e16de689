"""Common parts of the formats of Gaussians: quantisation, Morton order, axes."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from ..gaussians import Gaussians
from ..gaussians.cloud import as_precise_as_needed

# One row for each Gaussian
Vectors = Float[np.ndarray, "gaussian 3"]
Quaternions = Float[np.ndarray, "gaussian 4"]
Integers = Int[np.ndarray, " gaussian"]

# Logit of each byte of opacity. 0 and 1 have no finite one: the outer bytes mean half a step less.
_ALPHA = np.clip(np.arange(256) / 255, 0.5 / 255, 254.5 / 255)
LOGITS = np.log(_ALPHA / (1 - _ALPHA)).astype(np.float32)
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # the components beside the i-th
MIN_SCALE, MAX_SCALE = np.finfo(np.float32).tiny, np.finfo(np.float32).max  # what a scale can be and have a logarithm


LEVEL_COUNT, PASSES = 256, 12  # of `levels`: one level for each byte; passes of Lloyd's algorithm
# From the axes of PLY files and the scene (y down, z forward) to those of .spz and glTF (y up, z back), and back: half
# a turn around x, which negates y, z and the harmonics that are odd in y and z together.
TURN_MEAN = np.array([1, -1, -1])
TURN_ROTATION = np.array([1, 1, -1, -1])  # of (w, x, y, z)
# y, z, x | xy, yz, z^2, xz, x^2 - y^2 | and so on
TURN_HARMONICS = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)[:, None]

BITS = 21  # of Morton's order per axis; three times as many fit into 64
GAPS = [(32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3)]
GAPS += [(2, 0x1249249249249249)]


def array(tensor: Float[Tensor, "*shape"]) -> Float[np.ndarray, "*shape"]:
    return tensor.detach().cpu().float().contiguous().numpy()


def cloud(
    means: Vectors,
    quaternions: Quaternions,
    log_scales: Vectors,
    opacities: Float[np.ndarray, " gaussian"],
    harmonics: Float[np.ndarray, "gaussian coefficient 3"],
    antialiased: bool = False,
) -> Gaussians:
    """Gaussians of arrays, in float32 and in memory of their own; centres of float64 as they need it."""
    named = {"means": means, "quaternions": quaternions, "log_scales": log_scales}
    named |= {"opacities": opacities, "harmonics": harmonics}
    with np.errstate(over="ignore", invalid="ignore"):  # infinite values are found by `checks.checked`
        tensors = {name: torch.from_numpy(np.array(x, np.float32, order="C")) for name, x in named.items()}
        if means.dtype == np.float64:
            tensors["means"] = as_precise_as_needed(torch.from_numpy(np.array(means)), tensors["log_scales"])
    return Gaussians(**tensors, antialiased=antialiased)


def to_byte(x: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Round to the nearest of 0 to 255."""
    return np.clip(np.rint(x), 0, 255).astype(np.uint8)


def alpha_to_byte(logits: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """255 times the sigmoid, without overflow."""
    return to_byte(127.5 * (1 + np.tanh(logits / 2)))


def to_scales(log_scales: Vectors) -> Vectors:
    """Standard deviations, in double precision and within the range of float32."""
    with np.errstate(over="ignore"):
        return np.exp(log_scales.astype(np.float64)).clip(MIN_SCALE, MAX_SCALE)


def from_scales(scales: Vectors) -> Vectors:
    """Logarithms of scales: of 0 that of the smallest, and of negative ones NaN, which later checks report."""
    with np.errstate(invalid="ignore"):
        return np.log(np.where(scales == 0, MIN_SCALE, scales.astype(np.float64)))


def unit(quaternions: Quaternions) -> Quaternions:
    """Quaternions of length 1, in double precision, which does not overflow for float32 input."""
    quaternions = quaternions.astype(np.float64)
    return quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)


def without_largest(quaternions: Quaternions) -> tuple[Integers, Vectors]:
    """Index of the largest component, and the other three, at most sqrt(1/2), signed to make the largest positive."""
    quaternions = unit(quaternions)
    largest = np.abs(quaternions).argmax(-1)
    sign = np.sign(np.take_along_axis(quaternions, largest[:, None], -1))
    return largest, sign * np.take_along_axis(quaternions, OTHERS[largest], -1)


def with_largest(largest: Integers, rest: Vectors) -> Quaternions:
    """Inverse of `without_largest`: the fourth component follows from unit length."""
    quaternions = np.empty((len(rest), 4))
    np.put_along_axis(quaternions, OTHERS[largest], rest, -1)
    missing = np.sqrt(np.maximum(0, 1 - (rest**2).sum(-1)))
    np.put_along_axis(quaternions, largest[:, None], missing[:, None], -1)
    return quaternions


def morton_order(points: Float[np.ndarray, "point 3"]) -> Int[np.ndarray, " point"]:
    """Indices that sort points along a Z-curve through their bounding box (Morton 1966); equals keep their order."""
    if not len(points):
        return np.arange(0)
    low, extent = points.min(0).astype(float), np.ptp(points.astype(float), axis=0)
    cells = (points - low) / np.where(extent > 0, extent, 1) * (2**BITS - 1)
    spread = cells.astype(np.uint64)
    for shift, mask in GAPS:  # two zeros between any two bits, by halving blocks of bits
        spread = (spread | spread << np.uint64(shift)) & np.uint64(mask)
    x, y, z = spread.T
    return np.argsort(x | y << np.uint64(1) | z << np.uint64(2), kind="stable")


def levels(values: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, " level"]:
    """256 numbers in rising order for quantising `values`; up to 256 distinct values stay exact.

    Optimal levels have the density of the values to the power 1/3 (Panter and Dite 1951). Between neighbours at
    distance `gap` with c occurrences that is (c / gap)^(1/3) gap of a level. So initialised, levels are refined by
    k-means (Lloyd 1982).
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
