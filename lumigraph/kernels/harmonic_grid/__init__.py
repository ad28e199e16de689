"""Density and view-dependent colour of a sparse grid, in one lookup (Fridovich-Keil and Yu 2022, section 3.1)."""

import torch
from jaxtyping import Float
from torch import Tensor

from .._operation import Facts, door, implementation, require
from ..sparse_grid import Nodes, shell, some_nodes, through_the_shell

FACTS = Facts(unit="samples", outputs=2, differentiable=(3, 4), typical=2, compiled=2, smooth=(4,))

BANDS = 3  # harmonics up to degree 2
COEFFICIENTS = BANDS**2


@door
def harmonic_grid(
    points: Float[Tensor, "sample 3"],
    directions: Float[Tensor, "sample 3"],
    nodes: Nodes,
    density: Float[Tensor, " row"],
    harmonics: Float[Tensor, "row 9 3"],
) -> tuple[Float[Tensor, " sample"], Float[Tensor, "sample 3"]]:
    """Trilinear density, and colour of trilinear spherical harmonics of degree 2 in each sample's direction:

        sigma = sum_v w_v(x) density_v,    c = sum_v w_v(x) sum_lm Y_lm(d) harmonics_v,lm

    over the eight nodes v around the point; a node without a row counts as 0. Neither is activated. The 27 interpolated
    coefficients of a sample are not stored.

    points, nodes: as for `sparse_grid`
    directions:    unit length
    harmonics:     (nodes.count, 9, 3), in the order of `spherical_harmonics`
    Differentiable in density and harmonics.
    """
    require(len(density) == nodes.count, f"{len(density)} rows of values, where nodes have {nodes.count}")
    return implementation("harmonic_grid", points)(points, directions, nodes, density, harmonics)


def cases(generator: torch.Generator):
    """Test inputs for all engines: odd shapes, empty tables, every border of the cube, and beyond it."""
    for samples, shape, share in [
        (0, (4, 4, 4), 0.5),
        (1, (2, 2, 2), 1.0),
        (130, (9, 5, 7), 0.5),
        (40, (5, 5, 5), 0.0),
        (3, (3, 2, 4), 1.0),
        (200, (40, 3, 5), 0.4),
    ]:
        nodes = some_nodes(shape, share, generator)
        points = torch.randint(-(2**9), 2**12 + 2**9, (samples, 3), generator=generator) / 2**12
        yield _with_values(points, nodes, generator)
    part = some_nodes((5, 9, 3), 0.7, generator).part(torch.arange(40, 3, -2))
    yield _with_values(torch.cartesian_prod(*[torch.tensor([-0.5, 0.0, 0.28125, 1.0, 1.5])] * 3), part, generator)


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """Samples along rays through a shell in a grid of 129^3 nodes, as for `sparse_grid`."""
    points, directions, nodes, density, harmonics = _with_values(
        through_the_shell(size, 0.5 / 128, generator), shell(129), generator, run=16
    )
    return points, directions, nodes, density.requires_grad_(), harmonics.requires_grad_()


def _with_values(points: Tensor, nodes: Nodes, generator: torch.Generator, run: int = 2):
    """Add directions and values to points and nodes. Runs of `run` samples share a direction, as on a ray."""
    directions = torch.nn.functional.normalize(torch.randn(len(points), 3, generator=generator), dim=-1)
    directions = directions[torch.arange(len(points)) // run * run]
    values = torch.randn(nodes.count, 9, 3, generator=generator)
    return points, directions, nodes, torch.randn(nodes.count, generator=generator), values
