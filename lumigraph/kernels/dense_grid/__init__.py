"""Trilinear interpolation of a dense grid's channels, for voxel grids of density and features."""

import torch
from jaxtyping import Float
from torch import Tensor

from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="samples", outputs=1, differentiable=(0, 1), typical=3, compiled=3, smooth=(5,))

UNIT = torch.tensor([[0.0] * 3, [1.0] * 3])


@door
def dense_grid(
    points: Float[Tensor, "sample 3"], grid: Float[Tensor, "x y z channel"], box: Float[Tensor, "2 3"]
) -> Float[Tensor, "sample channel"]:
    """Trilinear interpolation of all channels at each point (Sun 2022, section 3.1, "interp").

        u = (size - 1) (p - box_0) / (box_1 - box_0)
        out(p) = sum over corners c of  prod_a (1 - |u_a - c_a|)  grid[c]

    grid: two corners or more along each axis, less than 2^32 numbers in all
    box:  the lower and the upper of the grid's outermost corners; points beyond are clamped to it
    Returns (S, channels), the same as `torch.nn.functional.grid_sample` with aligned corners gives; differentiable in
    the grid and in the points (on a face and beyond it a coordinate gets no gradient).
    """
    enough = min(grid.shape[:3]) > 1 and grid.shape[3] > 0 and grid.numel() < 1 << 32
    require(enough, f"a grid of {tuple(grid.shape)} should have two corners along each axis and below 2^32 numbers")
    return implementation("dense_grid", points)(points, grid, box)


def cases(generator: torch.Generator):
    """Test inputs for all engines: one channel and many, the smallest grid, every face, and beyond it."""
    for samples, shape in [(0, (3, 4, 5, 2)), (1, (2, 2, 2, 1)), (63, (5, 3, 9, 1)), (200, (9, 17, 5, 12))]:
        yield _inputs(samples, shape, generator)
    borders = torch.cartesian_prod(*[torch.tensor([-0.5, 0.0, 0.28125, 1.0, 1.5])] * 3)
    yield borders, _inputs(0, (5, 9, 3, 4), generator)[1], UNIT
    off_the_planes = torch.tensor([[0.1, 0.3, 0.9], [0.7, 1.2, -0.1]])  # of the grid, where the slope jumps
    yield off_the_planes, torch.arange(3 * 4 * 5 * 2.0).sin().view(3, 4, 5, 2), UNIT


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """Samples as in a training step: runs of 32 through a grid of 128^3 corners with the 12 channels of Sun 2022, half
    a voxel apart. The reference is `torch.nn.functional.grid_sample`. Points get no gradient there."""
    start = 0.2 + 0.6 * torch.rand(size // 32, 1, 3, generator=generator)
    direction = torch.nn.functional.normalize(torch.randn(size // 32, 1, 3, generator=generator), dim=-1)
    points = (start + direction * torch.arange(32)[:, None] * 0.5 / 127).reshape(-1, 3)
    return points, torch.randn(128, 128, 128, 12, generator=generator).requires_grad_(), UNIT


def _inputs(samples: int, shape: tuple[int, ...], generator: torch.Generator):
    """Random points and grid. Sizes are a power of two and one more, or small, and points multiples of 2^-12, so that
    cells do not depend on rounding."""
    points = torch.randint(-(2**9), 2**12 + 2**9, (samples, 3), generator=generator) / 2**12
    box = torch.tensor([[-1.0, -0.5, 0.25], [1.0, 1.5, 0.75]])
    return box[0] + points * (box[1] - box[0]), 2 * torch.rand(*shape, generator=generator) - 1, box
