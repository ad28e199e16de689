"""Real spherical harmonics of directions."""

from math import pi, sqrt

import torch
from jaxtyping import Float
from torch import Tensor

from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="directions", outputs=1, differentiable=(0,), typical=4, compiled=0, smooth=(4,))

# What makes each polynomial's square integrate to one over the sphere: K_lm, l the band and m the order.
K00, K1 = sqrt(1 / (4 * pi)), sqrt(3 / (4 * pi))
K20, K21, K22 = sqrt(5 / (16 * pi)), sqrt(15 / (4 * pi)), sqrt(15 / (16 * pi))
K30, K31, K32, K33 = sqrt(7 / (16 * pi)), sqrt(21 / (32 * pi)), sqrt(105 / (16 * pi)), sqrt(35 / (32 * pi))


@door
def spherical_harmonics(directions: Float[Tensor, "ray 3"], bands: int) -> Float[Tensor, "ray coefficient"]:
    """The bands^2 real, orthonormal spherical harmonics Y_lm with l < bands, in the order l (l + 1) + m.

    Signs follow the convention of splat files and instant-ngp: Y_1 = sqrt(3 / 4 pi) (-y, z, -x).
    They are the polynomials in x, y, z that agree with Y_lm on the unit sphere (Sloan 2013); the gradient is theirs.

    directions: unit length
    bands:      1 to 4 (degree 0 to 3)
    """
    require(1 <= bands <= 4, f"there are 1 to 4 bands, not {bands}")
    return implementation("spherical_harmonics", directions)(directions, bands)


def cases(generator: torch.Generator):
    """Test inputs for all engines: directions for each number of bands."""
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    yield axes, 4
    for rays, bands in [(0, 4), (1, 1), (1, 4), (63, 2), (129, 3), (200, 4)]:
        yield _directions(rays, generator), bands


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """Directions of a training step's samples, in four bands as in Instant-NGP."""
    return _directions(size, generator).requires_grad_(), 4


def _directions(rays: int, generator: torch.Generator) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(rays, 3, generator=generator), dim=-1)
