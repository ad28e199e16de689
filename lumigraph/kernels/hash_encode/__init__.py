"""Multiresolution hash encoding: features of a point, looked up at many scales."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from .._dispatch import implementation

PRIMES = (1, 2_654_435_761, 805_459_861)  # section 3; the first is 1 so that neighbours in x stay neighbours


@dataclass(frozen=True)
class HashLevels:
    """Grid sizes of a pyramid: N_l = floor(N_min b^l), with b such that the last is N_max (Müller 2022, eqs. 2, 3).

    A level whose (N_l + 1)^3 corners fit into 2^log2_entries has them all (no collisions); finer ones are hashed.
    """

    levels: int = 16
    features: int = 2
    log2_entries: int = 19
    coarsest: int = 16
    finest: int = 2048

    @property
    def resolutions(self) -> list[int]:
        growth = (self.finest / self.coarsest) ** (1 / max(self.levels - 1, 1))
        return [int(self.coarsest * growth**level + 1e-9) for level in range(self.levels)]

    @property
    def sizes(self) -> list[int]:
        """Entries per level."""
        return [min((n + 1) ** 3, 2**self.log2_entries) for n in self.resolutions]

    @property
    def offsets(self) -> list[int]:
        """Where each level begins in the table; one longer than there are levels."""
        offsets = [0]
        for size in self.sizes:
            offsets.append(offsets[-1] + size)
        return offsets


def hash_encode(
    points: Float[Tensor, "sample 3"], table: Float[Tensor, "entry feature"], levels: HashLevels
) -> Float[Tensor, "sample width"]:
    """Trilinear interpolation of each level's features around each point (Müller 2022, section 3).

    Level l scales the point by N_l and blends the eight corners c of its cell. A corner's entry is
        c_x + (N_l + 1) c_y + (N_l + 1)^2 c_z                    where all corners fit,
        (c_x p_0 xor c_y p_1 xor c_z p_2) mod 2^log2_entries     elsewhere (eq. 4, 32-bit unsigned).

    points: in the unit cube; those outside are clamped to it. The point 1.0 belongs to the last cell.
    table:  (levels.offsets[-1], levels.features), all levels end to end
    Returns (S, levels * features), level by level; differentiable in the table and in the points (a clamped
    coordinate gets no gradient).
    """
    return implementation("hash_encode", points)(points, table, levels)
