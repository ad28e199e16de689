"""Octree: density and harmonics in cells of several sizes (Yu 2021, arXiv 2103.14024, section 4)."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Octree:
    """A cube divided by two along each axis, and each of the eight cells again where the scene needs it. What a cell
    holds is the same everywhere inside of it.

    child:     for each of a node's eight cells (x, y, z), 0 for a leaf, else how many nodes further on it is divided
    density:   per scene unit, of each cell
    harmonics: coefficients of each cell; the colour along a direction is sigmoid(Σ coefficient · basis), sRGB-encoded
    low, size: the cube's corner and side, in the scene's frame
    """

    child: Int[Tensor, "node 2 2 2"]
    density: Float[Tensor, "node 2 2 2"]
    harmonics: Float[Tensor, "node 2 2 2 basis 3"]
    low: Float[Tensor, " 3"]
    size: float
