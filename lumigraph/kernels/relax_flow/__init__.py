"""Relaxation of a flow field: the equations of variational refinement, solved a few steps further."""

import torch
from jaxtyping import Float
from torch import Tensor

from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="pixels", unit_axes=2, outputs=1, differentiable=(), typical=1, compiled=1)


@door
def relax_flow(
    start: Float[Tensor, "height width 2"],
    data: Float[Tensor, "height width 5"],
    right: Float[Tensor, "height width"],
    below: Float[Tensor, "height width"],
    iterations: int,
    relaxation: float,
) -> Float[Tensor, "height width 2"]:
    """A flow (u, v) after steps of successive over-relaxation (Young 1954; Brox 2004) towards the solution of

        a u + b v + sum_n w_n (u - u_n) = e        b u + c v + sum_n w_n (v - v_n) = f

    at every pixel with its four neighbours n. In turn pixels whose row and column have an even sum, and those with an
    odd one, move `relaxation` times the way to their solution with the neighbours as they are: first u, then v.

    data: a, b, c, e, f; a and c at least 0
    right, below: w between a pixel and the next one of its row, of its column; positive; the last ones have no effect
    Not differentiable.
    """
    require(iterations >= 0 and 0 < relaxation < 2, f"{iterations} steps of {relaxation} do not lead to a solution")
    with torch.no_grad():
        return implementation("relax_flow", start)(start, data, right, below, iterations, relaxation)


def cases(generator: torch.Generator):
    """Inputs that every engine must agree on: lines, odd sizes, no steps."""
    for height, width, iterations, relaxation in [(1, 2, 3, 1.0), (9, 14, 4, 1.6), (1, 7, 2, 1.9), (6, 1, 2, 0.7)]:
        yield _inputs(height, width, iterations, relaxation, generator)
    start, data, right, below, *_ = _inputs(5, 4, 1, 1.0, generator)
    yield start, data, right, below, 0, 1.0
    yield start[:0], data[:0], right[:0], below[:0], 2, 1.0


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """A square picture of so many pixels, five steps."""
    side = max(round(size**0.5), 1)
    return _inputs(side, side, 5, 1.6, generator)


def _inputs(height, width, iterations, relaxation, generator):
    def uniform(*shape):
        return torch.rand(shape, generator=generator)

    a, c, e, f = (uniform(height, width) for _ in range(4))
    data = torch.stack([a, (a * c).sqrt() * (2 * uniform(height, width) - 1), c, e, f], -1)
    weights = (0.1 + uniform(height, width) for _ in range(2))
    return 4 * uniform(height, width, 2) - 2, data, *weights, iterations, relaxation
