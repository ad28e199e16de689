"""Trilinear interpolation in a sparse grid: a table has rows for the occupied nodes only."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Int32
from torch import Tensor

from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="samples", outputs=1, differentiable=(0, 2), typical=2, compiled=3, smooth=(7,))


@dataclass(frozen=True)
class Nodes:
    """Table row of each node of a grid over the unit cube; made by `of`, `all` or `part`.

    Node (x, y, z) of X Y Z is at (x / (X - 1), y / (Y - 1), z / (Z - 1)); the first and the last are on the cube's
    faces. A node's number is (x Y + y) Z + z.

    index: row of each node, -1 for none; no row belongs to two nodes
    rows:  int32; table row for each row that `index` names, -1 for none, in a table of `count` rows; empty for identity
    """

    index: Int32[Tensor, "x y z"]
    rows: Int32[Tensor, " row"]
    count: int

    @classmethod
    def of(cls, numbers: Int[Tensor, " row"], shape: tuple[int, int, int]) -> Nodes:
        """Nodes of these numbers, each with the index of its number as row. Raises ValueError unless all differ."""
        require(min(shape) >= 2 and shape[0] * shape[1] * shape[2] < 1 << 31, f"a grid cannot have {shape} nodes")
        total = shape[0] * shape[1] * shape[2]
        inside = len(numbers) == 0 or (int(numbers.min()) >= 0 and int(numbers.max()) < total)
        require(inside, f"numbers of nodes go from 0 to {total - 1}")
        index = torch.full((total,), -1, dtype=torch.int32, device=numbers.device)
        rows = torch.arange(len(numbers), dtype=torch.int32, device=numbers.device)
        index[numbers] = rows
        require(torch.equal(index[numbers], rows), "two rows belong to one node")
        return cls(index.view(shape), rows[:0], len(rows))

    @classmethod
    def all(cls, shape: tuple[int, int, int]) -> Nodes:
        """A dense grid: the row of every node is its number."""
        return cls.of(torch.arange(shape[0] * shape[1] * shape[2]), shape)

    def part(self, rows: Int[Tensor, " some"]) -> Nodes:
        """The same nodes for a table of only these rows, in this order. The index is shared."""
        here = torch.full_like(self.named, -1)
        here[rows] = torch.arange(len(rows), dtype=torch.int32, device=rows.device)
        return Nodes(self.index, here, len(rows))

    @property
    def named(self) -> Int32[Tensor, " row"]:
        """`rows`, with the identity written out."""
        return self.rows if len(self.rows) else torch.arange(self.count, dtype=torch.int32, device=self.index.device)

    def to(self, device: torch.device | str) -> Nodes:
        return Nodes(self.index.to(device), self.rows.to(device), self.count)


@door
def sparse_grid(
    points: Float[Tensor, "sample 3"], nodes: Nodes, values: Float[Tensor, "row channel"]
) -> Float[Tensor, "sample channel"]:
    """Trilinear interpolation of the values at the eight nodes around each point; a node without a row counts as 0.

    points: in the unit cube; those outside are clamped to it. The point 1.0 belongs to the last cell
    nodes:  table row of each node; trusted to be unchanged since it was made
    values: (nodes.count, channel)
    Differentiable in the values and in the points (a clamped coordinate gets no gradient).
    """
    require(len(values) == nodes.count, f"{len(values)} rows of values, where nodes have {nodes.count}")
    return implementation("sparse_grid", points)(points, nodes, values)


def cases(generator: torch.Generator):
    """Test inputs for all engines: odd shapes, empty tables, every border of the cube, and beyond it."""
    for samples, shape, share, channels in [
        (0, (4, 4, 4), 0.5, 2),
        (1, (2, 2, 2), 1.0, 1),
        (63, (9, 5, 7), 0.5, 3),
        (129, (33, 17, 9), 0.3, 16),
        (200, (3, 40, 5), 0.6, 19),
        (40, (5, 5, 5), 0.0, 4),
    ]:
        nodes = some_nodes(shape, share, generator)
        points = torch.randint(-(2**9), 2**12 + 2**9, (samples, 3), generator=generator) / 2**12
        yield points, nodes, torch.randn(nodes.count, channels, generator=generator)
    nodes = some_nodes((5, 9, 3), 0.7, generator).part(torch.arange(20, 3, -2))
    yield torch.cartesian_prod(*[torch.tensor([-0.5, 0.0, 0.28125, 1.0, 1.5])] * 3), nodes, torch.randn(9, 2)
    off_the_planes = torch.tensor([[0.1, 0.3, 0.9], [0.7, 1.2, -0.1]])  # of the grid, where the slope jumps
    yield off_the_planes, Nodes.all((3, 4, 2)), torch.arange(24.0).sin()[:, None]


def benchmark_case(generator: torch.Generator, size: int = 2**18, channels: int = 12):
    """Samples as in a training step: runs of 16 through a shell in a grid of 129^3 nodes, half a cell apart. Points get
    no gradient there."""
    nodes = shell(129)
    values = torch.randn(nodes.count, channels, generator=generator)
    return through_the_shell(size, 0.5 / 128, generator), nodes, values.requires_grad_()


def some_nodes(shape: tuple[int, int, int], share: float, generator: torch.Generator) -> Nodes:
    """A random share of all nodes, with rows in random order."""
    total = shape[0] * shape[1] * shape[2]
    order = torch.randperm(total, generator=generator)
    return Nodes.of(order[: int(share * total)], shape)


def shell(n: int) -> Nodes:
    """Nodes of n^3 at distances from 0.3 to 0.36 from the cube's middle."""
    place = torch.linspace(-0.5, 0.5, n)
    radius = (place[:, None, None] ** 2 + place[:, None] ** 2 + place**2).sqrt()
    return Nodes.of(((radius > 0.3) & (radius < 0.36)).flatten().nonzero()[:, 0], (n, n, n))


def through_the_shell(samples: int, step: float, generator: torch.Generator) -> Float[Tensor, "sample 3"]:
    """Runs of 16 samples from where rays enter the shell."""
    out = torch.nn.functional.normalize(torch.randn(samples // 16, 1, 3, generator=generator), dim=-1)
    aside = torch.randn(samples // 16, 1, 3, generator=generator)
    direction = torch.nn.functional.normalize(0.5 * aside - out, dim=-1)
    return (0.5 + 0.36 * out + direction * step * torch.arange(16)[:, None]).reshape(-1, 3).contiguous()
