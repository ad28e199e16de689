"""Functions of directions in real spherical harmonics of any band, and what a rotation does to their coefficients."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor


def harmonics(directions: Float[Tensor, "*point 3"], bands: int) -> Float[Tensor, "*point basis"]:
    """Real harmonics of bands 0 to `bands` - 1, orthonormal on the sphere, order (l, m) with m from -l to l.

    directions: unit length
    K_lm q_lm(z) times the real or imaginary part of (x + i y)^|m|, q by the three-term recursion (Sloan 2013, sec. 2).
    Unlike `kernels.spherical_harmonics` there are as many bands as one likes.
    """
    x, y, z = directions.unbind(-1)
    values: dict[tuple[int, int], Tensor] = {}
    real, imaginary, top = torch.ones_like(x), torch.zeros_like(x), 1.0
    for m in range(bands):
        before, here = torch.zeros_like(z), torch.full_like(z, top)
        for degree in range(m, bands):
            norm = math.sqrt((2 * degree + 1) / (4 * math.pi) * math.factorial(degree - m) / math.factorial(degree + m))
            scaled = norm * (math.sqrt(2) if m else 1.0) * here
            values[degree, m] = scaled * real
            values[degree, -m] = scaled * imaginary if m else values[degree, 0]
            here, before = ((2 * degree + 1) * z * here - (degree + m) * before) / (degree + 1 - m), here
        real, imaginary, top = x * real - y * imaginary, x * imaginary + y * real, -(2 * m + 1) * top
    return torch.stack([values[degree, m] for degree in range(bands) for m in range(-degree, degree + 1)], -1)


def band(degree: int) -> slice:
    """Slice of the coefficients of a band."""
    return slice(degree**2, (degree + 1) ** 2)


def band_sizes(bands: int) -> list[int]:
    return [2 * degree + 1 for degree in range(bands)]


def turning(rotations: Float[Tensor, "*rotation 3 3"], bands: int) -> list[Float[Tensor, "*rotation _ _"]]:
    """Wigner's matrices D of each band: harmonics(R x) = D(R) harmonics(x), so that what has coefficients f has D f
    once it is turned. Found from directions, of which there are more than enough to determine them."""
    generator = torch.Generator().manual_seed(0)
    some = torch.randn(4 * (2 * bands - 1), 3, generator=generator, dtype=torch.float64).to(rotations)
    some = some / some.norm(dim=-1, keepdim=True)
    before = harmonics(some, bands)
    after = harmonics(torch.einsum("...ij,pj->...pi", rotations, some), bands)
    inverse = [torch.linalg.pinv(before[:, band(degree)].double()).to(before) for degree in range(bands)]
    return [(inverse[degree] @ after[..., band(degree)]).mT for degree in range(bands)]
