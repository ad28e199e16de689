"""Morton's order: neighbours in space become neighbours in a row."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, UInt

BITS = 21  # per axis; three times as many fit into 64
GAPS = [(32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3)]
GAPS += [(2, 0x1249249249249249)]


def morton_order(points: Float[np.ndarray, "point 3"]) -> Int[np.ndarray, " point"]:
    """Indices that sort points along a Z-curve through their bounding box (Morton 1966); equals keep their order."""
    if not len(points):
        return np.arange(0)
    low, extent = points.min(0).astype(float), np.ptp(points.astype(float), axis=0)
    cells = (points - low) / np.where(extent > 0, extent, 1) * (2**BITS - 1)
    x, y, z = _spread(cells.astype(np.uint64)).T
    return np.argsort(x | y << np.uint64(1) | z << np.uint64(2), kind="stable")


def _spread(x: UInt[np.ndarray, "point 3"]) -> UInt[np.ndarray, "point 3"]:
    """Two zeros between any two bits, by halving blocks of bits."""
    for shift, mask in GAPS:
        x = (x | x << np.uint64(shift)) & np.uint64(mask)
    return x
