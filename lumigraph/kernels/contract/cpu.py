"""Numba: each point by itself."""

import math

import numpy as np
from numba import njit, prange

from .._operation import empty


@njit(inline="always")
def scale_of(x, y, z):
    """1 / |x|, at most 1, and the contraction's scale factor c(x) / x."""
    one, radius = np.float32(1), np.float32(math.sqrt(x * x + y * y + z * z))
    inverse = one / radius if radius > one else one
    return inverse, np.float32(0.5) * (one + one - inverse) * inverse


@njit(inline="always")
def cube_root(x):
    """x^(1/3) of numbers above 0: a third of the exponent, then Newton's method."""
    third = np.int32(np.float32(np.float32(x).view(np.int32)) * np.float32(1 / 3))
    y = np.int32(third + np.int32(709921077)).view(np.float32)
    for _ in range(3):
        y = np.float32(2 / 3) * y + x / (np.float32(3) * y * y)
    return y


@njit(inline="always")
def _stretch(inverse, across):
    """|det J|^(1/3) from the results of `scale_of`; 1/2 within the unit ball."""
    outside = cube_root(np.float32(0.5) * inverse * inverse * across * across)
    return across if inverse == 1 else outside


@njit(parallel=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _contract(points, coordinates, stretch):
    """Contract points. stretch: output array, empty if not wanted"""
    for i in prange(len(points)):
        inverse, across = scale_of(points[i, 0], points[i, 1], points[i, 2])
        for axis in range(3):
            coordinates[i, axis] = across * points[i, axis]
        if len(stretch):
            stretch[i] = _stretch(inverse, across)


def run(points, stretch):
    coordinates, lengths = empty(len(points), 3), empty(len(points) if stretch else 0)
    _contract(*(x.numpy() for x in (points.detach().contiguous(), coordinates, lengths)))
    return coordinates, lengths if stretch else None
