"""Factorised grids: values in a box as sums of products of planes and lines, or of three lines."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="samples", outputs=1, differentiable=(1,), typical=2, compiled=4, smooth=(5, 11))

Kind = Literal["vm", "cp"]
MODES = ((1, 2, 0), (0, 2, 1), (0, 1, 2))  # the two axes of a plane, and that of the line beside it
MAX_NODES = 1 << 14  # nodes along an axis, so that the rows of a table are counted in 32 bits


@dataclass(frozen=True)
class Factors:
    """Layout of a table as a factorised grid of nodes (x, y, z): one component of all factors in each column.

    vm: planes over (y, z), (x, z), (x, y), then lines along x, y, z (vector-matrix, Chen 2022, eq. 3)
    cp: lines along x, y, z (eq. 2)
    A factor's nodes lie row by row, the last axis fastest.
    """

    kind: Kind
    nodes: tuple[int, int, int]

    def __post_init__(self) -> None:
        require(self.kind in ("vm", "cp"), f"factors are vm or cp, not {self.kind!r}")
        require(all(2 <= n <= MAX_NODES for n in self.nodes), f"{self.nodes} nodes cannot be; 2 to {MAX_NODES:,} can")

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """Nodes of each factor, in the order of the table."""
        planes = [(self.nodes[a], self.nodes[b]) for a, b, _ in MODES] if self.kind == "vm" else []
        return [*planes, *((n,) for n in self.nodes)]

    @property
    def sizes(self) -> list[int]:
        """Rows of each factor."""
        return [torch.Size(shape).numel() for shape in self.shapes]

    @property
    def rows(self) -> int:
        """Rows of a table."""
        return sum(self.sizes)

    @property
    def products(self) -> int:
        """Products of each component: three of planes and lines, or one of three lines."""
        return 3 if self.kind == "vm" else 1

    def split(self, table: Float[Tensor, "row component"]) -> list[Tensor]:
        """A table's factors, as views (*nodes, component)."""
        parts = zip(table.split(self.sizes), self.shapes, strict=True)
        return [part.view(*shape, table.shape[1]) for part, shape in parts]


@door
def factor_grid(
    points: Float[Tensor, "sample 3"], table: Float[Tensor, "row component"], factors: Factors, summed: bool = False
) -> Float[Tensor, "sample width"]:
    """Each component's product of factors at each point (Chen 2022, eqs. 2 to 4), planes and lines interpolated.

        vm: P_yz(y, z) l_x(x),  P_xz(x, z) l_y(y),  P_xy(x, y) l_z(z)
        cp: l_x(x) l_y(y) l_z(z)

    points: in the unit cube, whose corners are the outermost nodes; those outside are clamped to it
    table:  (factors.rows, components)
    summed: add up all products and components into one value, as for density
    Returns (S, products * components), product by product, or (S, 1); differentiable in the table. Bilinear in planes,
    linear along lines, so that their product is not trilinear (section 4.1).
    """
    require(len(table) == factors.rows, f"a table of {len(table):,} rows should have {factors.rows:,} for {factors}")
    return implementation("factor_grid", points)(points, table, factors, summed)


def cases(generator: torch.Generator) -> Iterator[tuple]:
    """Test inputs for all engines: both kinds, widths that lanes divide and others, borders and beyond."""
    kinds: tuple[Kind, Kind] = ("vm", "cp")
    for kind in kinds:
        for samples, nodes, components, summed in [
            (0, (4, 5, 6), 3, False),
            (1, (2, 3, 2), 1, True),
            (129, (7, 4, 5), 16, False),
            (63, (9, 6, 7), 5, True),
            (130, (5, 11, 6), 33, False),
            (3, (3, 2, 3), 2, True),
        ]:
            yield _inputs(samples, Factors(kind, nodes), components, summed, generator)
    for kind in kinds:
        _, table, factors, summed = _inputs(0, Factors(kind, (3, 5, 4)), 16, True, generator)
        yield torch.cartesian_prod(*[torch.tensor([-0.5, 0.0, 0.28125, 1.0, 1.5])] * 3), table, factors, summed


def benchmark_case(generator: torch.Generator, size: int = 2**18) -> tuple:
    """Density of VM-192 at 128^3 at a training step's samples: runs of 32 through the cube, half a node apart."""
    start = 0.2 + 0.6 * torch.rand(size // 32, 1, 3, generator=generator)
    direction = torch.nn.functional.normalize(torch.randn(size // 32, 1, 3, generator=generator), dim=-1)
    points = (start + direction * torch.arange(32)[:, None] / 256).reshape(-1, 3)
    factors = Factors("vm", (128, 128, 128))
    return points, (0.1 * torch.randn(factors.rows, 16, generator=generator)).requires_grad_(), factors, True


def _inputs(samples: int, factors: Factors, components: int, summed: bool, generator: torch.Generator) -> tuple:
    points = 1.25 * torch.rand(samples, 3, generator=generator) - 0.125
    return points, torch.randn(factors.rows, components, generator=generator), factors, summed
