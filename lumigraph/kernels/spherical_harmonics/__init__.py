"""Real spherical harmonics: a direction as smooth features."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from .._dispatch import implementation


def spherical_harmonics(directions: Float[Tensor, "ray 3"], bands: int) -> Float[Tensor, "ray coefficient"]:
    """The bands^2 real, orthonormal spherical harmonics Y_lm with l < bands, in the order l (l + 1) + m.

    Signs follow the convention of splat files and instant-ngp: Y_1 = sqrt(3 / 4 pi) (-y, z, -x).
    They are the polynomials in x, y, z that agree with Y_lm on the unit sphere (Sloan 2013); the gradient is theirs.

    directions: unit length
    bands:      1 to 4 (degree 0 to 3)
    """
    return implementation("spherical_harmonics", directions)(directions, bands)
