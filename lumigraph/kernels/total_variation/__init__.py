"""Total variation of a grid."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .._operation import Facts, door, implementation, require, require_indices
from ..sparse_grid import Nodes, shell, some_nodes

FACTS = Facts(unit="nodes", outputs=1, differentiable=(2,), typical=2, compiled=2, smooth=(4,))

EPSILON = 1e-9  # added to the square below, so that its root has a slope where all neighbours are alike


@door
def total_variation(
    chosen: Int[Tensor, " chosen"], nodes: Nodes, values: Float[Tensor, "row channel"]
) -> Float[Tensor, ""]:
    """Mean over the chosen nodes of sum_channels sqrt(dx^2 + dy^2 + dz^2 + 1e-9), where dx is the value of the next
    node along x less this one's (Rudin 1992; Fridovich-Keil and Yu 2022, eq. 3).

    A chosen node without a row counts as 0, and so does a difference to one.

    chosen: numbers of nodes; those that the step touched, or random ones. A dense grid is `Nodes.all`
    values: (nodes.count, channel)
    Differentiable in the values.
    """
    require(len(values) == nodes.count, f"{len(values)} rows of values, where nodes have {nodes.count}")
    require_indices("chosen", chosen, nodes.index.numel())
    return implementation("total_variation", values)(chosen, nodes, values)


def cases(generator: torch.Generator):
    """Test inputs for all engines: dense and sparse, no node, one more than once, every border."""
    for chosen, shape, share, channels in [
        (0, (4, 4, 4), 0.5, 2),
        (1, (2, 2, 2), 1.0, 1),
        (90, (9, 5, 7), 0.6, 3),
        (300, (40, 3, 5), 1.0, 19),
        (20, (4, 2, 3), 1.0, 2),
        (40, (5, 5, 5), 0.0, 4),
    ]:
        nodes = some_nodes(shape, share, generator)
        numbers = torch.randint(nodes.index.numel(), (chosen,), generator=generator)
        yield numbers, nodes, torch.randn(nodes.count, channels, generator=generator)
    nodes = some_nodes((5, 9, 3), 0.7, generator).part(torch.arange(40, 3, -2))
    yield torch.arange(5 * 9 * 3), nodes, torch.randn(nodes.count, 2, generator=generator)


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """A random half of the nodes of a shell in a grid of 129^3, in their order."""
    nodes = shell(129)
    numbers = (nodes.index.flatten() >= 0).nonzero()[:, 0]
    numbers = numbers[torch.rand(len(numbers), generator=generator) < 0.5][:size]
    return numbers, nodes, torch.randn(nodes.count, 28, generator=generator).requires_grad_()
