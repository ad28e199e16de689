"""Contraction: all of space in a ball of radius 1, for networks and grids of unbounded scenes."""

import torch
from jaxtyping import Float
from torch import Tensor

from .._operation import Facts, door, implementation

FACTS = Facts(unit="points", outputs=2, differentiable=(), typical=3, compiled=3)


@door
def contract(
    points: Float[Tensor, "point 3"], stretch: bool = False
) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"] | None]:
    """Coordinates of points, half of contract(x) (Barron 2022, eq. 10), and on request their stretch.

        c(x) = x / 2 for |x| <= 1, else (2 - 1 / |x|) x / (2 |x|)

    stretch: also return |det dc/dx|^(1/3), the length in coordinates of a scene unit, averaged over directions
    Not differentiable.
    """
    return implementation("contract", points)(points, stretch)


def cases(generator: torch.Generator):
    """Test inputs for all engines: the origin, points on the unit sphere, and points far out."""
    for points, stretch in [(0, True), (1, False), (70, False), (300, True)]:
        yield _inputs(points, generator), stretch
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    yield torch.cat([torch.zeros(1, 3), axes, 1e4 * axes, 1e-4 * axes]), True


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """Points of which about half lie within the unit ball."""
    return _inputs(size, generator), False


def _inputs(points: int, generator: torch.Generator) -> Tensor:
    """Points at distances from 0.06 to 16 in all directions."""
    directions = torch.nn.functional.normalize(torch.randn(points, 3, generator=generator), dim=-1)
    return 2 ** (8 * torch.rand(points, 1, generator=generator) - 4) * directions
