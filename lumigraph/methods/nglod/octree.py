"""A sparse octree around a surface, with features at the corners of its cells and a decoder for each level."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from ... import kernels
from ...components.fields.layers import MLP
from ...datasets.shapes import Shape
from ...kernels import Nodes
from ...kernels.octree_cells import Tree, code_of

CHILDREN = torch.cartesian_prod(*[torch.arange(2)] * 3)  # child 4 x + 2 y + z of a cell
MARGIN = 0.1  # sides of a cell beyond its corners within which a surface still makes a cell
FIRST_FEATURES = 1e-4  # deviation of features at first: a corner that few points reach adds little to coarser levels


class LevelCells(nn.Module):
    """Cells of one level: number (x n + y) n + z of each, rising, and which of its eight children are empty and inside
    of the shape, a bit for each.

    resolution: n, cells along each side of the cube [-1, 1]^3; a power of two
    """

    grows: ClassVar[tuple[str, ...]] = ("rows",)
    rows: Tensor

    def __init__(self, resolution: int):
        super().__init__()
        self.resolution = resolution
        self.register_buffer("rows", torch.zeros(0, 2, dtype=torch.int32))
        self._made: tuple[Tensor, int, tuple[Tensor, Nodes, Tree]] | None = None

    def place(self, points: Float[Tensor, "point 3"]) -> Int[Tensor, "point 3"]:
        """Whole numbers along each axis of the cells of points."""
        return ((points + 1) * (self.resolution / 2)).long().clamp(0, self.resolution - 1)

    def row(self, points: Float[Tensor, "point 3"]) -> Int[Tensor, " point"]:
        """Row of the cell that holds each point; -1 where there is none."""
        x, y, z = self.place(points).unbind(-1)
        return self.made[0][(x * self.resolution + y) * self.resolution + z].long()

    @property
    def where(self) -> Int[Tensor, "cell 3"]:
        """Whole numbers of the cells along each axis."""
        number, n = self.rows[:, 0].long(), self.resolution
        return torch.stack([number // (n * n), number // n % n, number % n], -1)

    @property
    def corners(self) -> Int[Tensor, " corner"]:
        """Numbers of the corners that some cell has, rising, in a grid of n + 1 along each axis."""
        around = (self.where[:, None] + CHILDREN.to(self.rows.device)).reshape(-1, 3)
        n = self.resolution + 1
        return torch.unique((around[:, 0] * n + around[:, 1]) * n + around[:, 2])

    @property
    def made(self) -> tuple[Int[Tensor, " place"], Nodes, Tree]:
        """Row of each cell of the dense grid, rows of corners, and the octree for rays: built on first use."""
        made = self._made
        if made is None or made[0] is not self.rows or made[1] != self.rows._version:
            n, rows = self.resolution, self.rows
            index = torch.full((n**3,), -1, dtype=torch.int32, device=rows.device)
            index[rows[:, 0].long()] = torch.arange(len(rows), dtype=torch.int32, device=rows.device)
            x, y, z = self.where.unbind(-1)
            codes = code_of(x, y, z, n.bit_length() - 1).int()
            tables = index, Nodes.of(self.corners, (n + 1, n + 1, n + 1)), Tree.of(codes)
            made = self._made = rows, rows._version, tables
        return made[2]


class Level(nn.Module):
    """Cells of one level, features at their corners, and a decoder of summed features and points to distances."""

    grows: ClassVar[tuple[str, ...]] = ("features",)

    def __init__(self, resolution: int, features: int, hidden_width: int):
        super().__init__()
        self.cells = LevelCells(resolution)
        self.features = nn.Parameter(torch.zeros(0, features))
        self.decoder = MLP(features + 3, hidden_width, 1)

    def fill(self, rows: Int[Tensor, "cell 2"], generator: torch.Generator) -> None:
        """Set the cells, with random features at their corners."""
        self.cells.rows = rows.int().to(self.features.device)
        drawn = torch.randn(len(self.cells.corners), self.features.shape[1], generator=generator)
        self.features.data = (FIRST_FEATURES * drawn).to(self.features.device)

    def feature(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point feature"]:
        """Trilinear interpolation of the corners' features (section 3.1)."""
        return kernels.sparse_grid(0.5 * points + 0.5, self.cells.made[1], self.features)

    def decoded(
        self, summed: Float[Tensor, "point feature"], points: Float[Tensor, "point 3"]
    ) -> Float[Tensor, " point"]:
        """f_theta_L(x, z) (eq. 4)."""
        return self.decoder(torch.cat([summed, points], -1))[:, 0]


class CodeOctree(nn.Module):
    """Levels from coarse to fine. The first has all cells; the others have those that may contain the surface."""

    levels: Any  # a ModuleList of Level

    def __init__(self, base_resolution: int, levels: int, features: int, hidden_width: int):
        super().__init__()
        self.levels = nn.ModuleList(Level(base_resolution << level, features, hidden_width) for level in range(levels))

    def __iter__(self) -> Iterator[Level]:
        return iter(self.levels)

    def __len__(self) -> int:
        return len(self.levels)

    def fill(self, shape: Shape, generator: torch.Generator) -> None:
        """Subdivide cells that may contain the surface of a shape."""
        first = self.levels[0].cells.resolution
        cells = torch.cartesian_prod(*[torch.arange(first)] * 3)
        near, _ = passed(shape, cells, first)
        for level in self.levels:
            n = level.cells.resolution
            children = (2 * cells[:, None] + CHILDREN).reshape(-1, 3)
            near_child, inside = passed(shape, children, 2 * n)
            near_child &= near.repeat_interleave(8)
            bits = ((inside & ~near_child).view(-1, 8).long() << torch.arange(8)).sum(-1)
            number = (cells[:, 0] * n + cells[:, 1]) * n + cells[:, 2]
            order = number.argsort()
            level.fill(torch.stack([number, bits], -1)[order], generator)
            cells = children[near_child]
            near = torch.ones(len(cells), dtype=torch.bool)

    def predictions(
        self, points: Float[Tensor, "point 3"]
    ) -> list[tuple[Int[Tensor, " held"], Float[Tensor, " held"]]]:
        """For each level the points in its cells, and their distances by its decoder: z(x; L) sums features of the
        levels up to L (eq. 3)."""
        found, held, summed = [], torch.arange(len(points), device=points.device), None
        for level in self.levels:
            there = level.cells.row(points[held]) >= 0
            held = held[there]
            feature = level.feature(points[held])
            summed = feature if summed is None else summed[there] + feature
            found.append((held, level.decoded(summed, points[held])))
        return found

    def distance(self, points: Float[Tensor, "point 3"], last: int) -> Float[Tensor, " point"]:
        """Signed distance at a level, counted from 0, in [-1, 1]^3.

        The surface lies in that level's cells. In the space outside them, the decoder of the finest cell around a point
        gives the size and the octree the sign: no decoder is trained outside of its cells.
        """
        out, held, summed = points.new_zeros(len(points)), None, None
        for number, level in enumerate(self.levels[: last + 1]):
            here = points if held is None else points[held]
            feature = level.feature(here)
            summed = feature if summed is None else summed + feature
            if number == last:
                value = level.decoded(summed, here)
                return value if held is None else out.index_copy(0, held, value)
            there = self.levels[number + 1].cells.row(here) >= 0
            if not bool(there.all()):
                left = (~there).nonzero()[:, 0]
                value = level.decoded(summed[left], here[left]).abs() * self._side(number, here[left])
                out = out.index_copy(0, left if held is None else held[left], value)
                stay = there.nonzero()[:, 0]
                held, summed = stay if held is None else held[stay], summed[stay]
        return out

    def _side(self, number: int, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """-1 for points whose empty child of a level's cell is inside, 1 for those outside."""
        cells = self.levels[number].cells
        x, y, z = (self.levels[number + 1].cells.place(points) & 1).unbind(-1)
        bits = cells.rows[cells.row(points), 1].long() >> (4 * x + 2 * y + z)
        return 1.0 - 2.0 * (bits & 1)

    def hidden(self, last: int) -> Float[Tensor, "corner hidden"]:
        """Input of the ReLU of a level's decoder at the corners of its cells.

        A cell lies in one cell of each coarser level, so the sum of their codes is trilinear in it, and so is a linear
        layer of the sum and the point: eight corners give it anywhere in the cell, for any number of levels.
        """
        level, n = self.levels[last], self.levels[last].cells.resolution
        number = level.cells.corners
        places = torch.stack([number // (n + 1) ** 2, number // (n + 1) % (n + 1), number % (n + 1)], -1) * (2 / n) - 1
        summed = sum(coarser.feature(places) for coarser in self.levels[: last + 1])
        return torch.cat([summed, places], -1) @ level.decoder.weights[0].T

    def bytes_at(self, last: int) -> int:
        """Bytes of what a level needs: cells and features up to it, and its decoder."""
        tables = [x for level in self.levels[: last + 1] for x in (level.cells.rows, level.features)]
        tensors = [*tables, *self.levels[last].decoder.parameters()]
        return sum(x.numel() * x.element_size() for x in tensors)


def passed(
    shape: Shape, cells: Int[Tensor, "cell 3"], resolution: int
) -> tuple[Bool[Tensor, " cell"], Bool[Tensor, " cell"]]:
    """Cells that the surface may pass through, and those with their middle inside."""
    side = 2 / resolution
    found = shape.known((cells + 0.5) * side - 1)
    assert found.distance is not None and found.occupancy is not None
    return found.distance.abs() <= side * (0.5 * 3**0.5 + MARGIN), found.occupancy > 0.5
