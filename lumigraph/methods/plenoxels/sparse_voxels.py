"""Density and harmonics at the nodes of a sparse grid, with upsampling and pruning."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numba import njit, prange
from torch import Tensor, nn
from torch.nn.functional import embedding

from ... import kernels
from ...components.training.row_optimizers import exchange
from ...kernels import Nodes
from ...kernels.harmonic_grid import COEFFICIENTS
from ...kernels.sparse_grid.cpu import CHUNK, corners

Cells = tuple[int, int, int]  # of a grid, along each axis
SHARE = 0.05  # of a fine grid's nodes that are not pruned, about


class SparseVoxels(nn.Module):
    """A grid over the coordinates [-1, 1]^3 whose nodes have a row of values each, or none (Fridovich-Keil and Yu 2022,
    section 3.1). All nodes have one at first, with a given density and grey in every direction.

    numbers:   of the nodes that have rows, rising (see `kernels.Nodes`)
    density:   (row, 1), before activation
    harmonics: (row, 27), before activation: 9 coefficients times 3 colours
    weights:   the largest weight in a picture that a sample next to each node had since `rebuild`; who trains the grid
               lets it decay
    """

    grows: ClassVar[tuple[str, ...]] = ("numbers", "density", "harmonics", "weights")
    cells: Tensor
    numbers: Tensor
    weights: Tensor
    density: nn.Parameter
    harmonics: nn.Parameter

    def __init__(self, cells: Cells, density: float):
        super().__init__()
        rows = (cells[0] + 1) * (cells[1] + 1) * (cells[2] + 1)
        self.register_buffer("cells", torch.tensor(cells))
        self.register_buffer("numbers", torch.arange(rows, dtype=torch.int32))
        self.register_buffer("weights", torch.zeros(rows))
        self.density = nn.Parameter(torch.full((rows, 1), density))
        self.harmonics = nn.Parameter(torch.zeros(rows, 3 * COEFFICIENTS))
        self._made: tuple[Tensor, int, Nodes] | None = None

    def __len__(self) -> int:
        return len(self.numbers)

    @staticmethod
    def bytes_of(cells: Cells, learning: bool) -> int:
        """Lower bound of a grid's bytes: its index, and the values of as many nodes as most scenes keep; in training,
        as much again for their mean squares."""
        nodes = (cells[0] + 1) * (cells[1] + 1) * (cells[2] + 1)
        return 4 * nodes + int(SHARE * nodes) * 4 * (1 + 3 * COEFFICIENTS) * (2 if learning else 1)

    @property
    def nodes(self) -> Nodes:
        """Row of each node; made on first use, and again where the numbers were loaded or moved."""
        made = self._made
        if made is None or made[0] is not self.numbers or made[1] != self.numbers._version:
            x, y, z = (self.cells + 1).tolist()
            made = self._made = self.numbers, self.numbers._version, Nodes.of(self.numbers.long(), (x, y, z))
        return made[2]

    @property
    def places(self) -> Float[Tensor, "row 3"]:
        """Coordinates of the nodes that have rows."""
        x, y, z = torch.unravel_index(self.numbers.long(), tuple((self.cells + 1).tolist()))
        return torch.stack([x, y, z], -1) * (2 / self.cells) - 1

    def density_at(self, places: Float[Tensor, "sample 3"]) -> Float[Tensor, " sample"]:
        """Density at coordinates, before activation."""
        return kernels.sparse_grid(places * 0.5 + 0.5, self.nodes, self.density)[:, 0]

    def at(
        self, places: Float[Tensor, "sample 3"], directions: Float[Tensor, "sample 3"]
    ) -> tuple[Float[Tensor, " sample"], Float[Tensor, "sample 3"]]:
        """Density and colour at coordinates, before activation."""
        return VoxelRows(self.nodes, self.density, self.harmonics).at(places, directions)

    def part(self, rows: Int[Tensor, " some"]) -> VoxelRows:
        """A small table of some rows, to which a step's sparse gradient is confined."""
        density, harmonics = (embedding(rows, table, sparse=True) for table in (self.density, self.harmonics))
        return VoxelRows(self.nodes.part(rows), density, harmonics)

    @torch.no_grad()
    def touched(self, places: Float[Tensor, "sample 3"]) -> Int[Tensor, " some"]:
        """Rows of the nodes around these coordinates, rising."""
        if places.is_cuda:
            marks = torch.zeros(len(self), dtype=torch.bool, device=places.device)
            for row in _rows_around(places * 0.5 + 0.5, self.nodes):
                marks[row[row >= 0]] = True
            return marks.nonzero()[:, 0]
        found = np.zeros(len(self), np.bool_)
        _mark((places * 0.5 + 0.5).contiguous().numpy(), *_arrays(self.nodes), found)
        return torch.from_numpy(np.flatnonzero(found))

    @torch.no_grad()
    def note(self, places: Float[Tensor, "sample 3"], weights: Float[Tensor, " sample"]) -> None:
        """Record samples' weights, each at the nearest node."""
        shape = self.cells + 1
        x, y, z = ((places * 0.5 + 0.5).clamp(0, 1) * self.cells + 0.5).long().unbind(-1)
        row = self.nodes.index.view(-1)[(x * shape[1] + y) * shape[2] + z].long()
        here = row >= 0
        self.weights.scatter_reduce_(0, row[here], weights[here], "amax")

    @torch.no_grad()
    def important(self, weight: float) -> Bool[Tensor, "x y z"]:
        """Cells at and next to nodes with at least a recorded weight (the paper's dilation). All cells, if there is
        none."""
        return self._around(self.weights > weight)

    @torch.no_grad()
    def dense(self, density: float) -> Bool[Tensor, "x y z"]:
        """Cells at and next to nodes with at least a density."""
        return self._around(self.density[:, 0] > density)

    def _around(self, rows: Bool[Tensor, " row"]) -> Bool[Tensor, "x y z"]:
        if not rows.any():
            return torch.ones(*self.cells.tolist(), dtype=torch.bool, device=self.numbers.device)
        shape = tuple((self.cells + 1).tolist())
        nodes = torch.zeros(shape, dtype=torch.bool, device=self.numbers.device)
        nodes.view(-1)[self.numbers[rows].long()] = True
        return _of_corners(nodes)

    @torch.no_grad()
    def keep(self, rows: Bool[Tensor, " row"]) -> None:
        """Keep only some rows; the other nodes become empty."""
        self.numbers, self.weights = self.numbers[rows], self.weights[rows]
        self.density, self.harmonics = nn.Parameter(self.density[rows]), nn.Parameter(self.harmonics[rows])

    @torch.no_grad()
    def rebuild(
        self, kept: Bool[Tensor, "x y z"], cells: Cells, optimizer: torch.optim.Optimizer | None = None
    ) -> None:
        """Resample to a grid of so many cells, keeping those that overlap a kept one, with interpolated values and
        optimizer moments.

        kept: cells of a grid of any size over the same coordinates
        """
        numbers = _nodes_of(_resized(kept, cells))
        shape = tuple(n + 1 for n in cells)
        x, y, z = torch.unravel_index(numbers, shape)
        points = torch.stack([x, y, z], -1) / torch.tensor(cells, device=numbers.device)
        old = self.nodes
        for name in ("density", "harmonics"):
            table = getattr(self, name)
            known = optimizer.state.get(table, {}) if optimizer else {}
            state = {key: kernels.sparse_grid(points, old, x) for key, x in known.items()}
            exchange(self, name, kernels.sparse_grid(points, old, table.data), optimizer, state)
        self.cells = torch.tensor(cells, device=numbers.device)
        self.numbers = numbers.to(torch.int32)
        self.weights = torch.zeros(len(numbers), device=numbers.device)


class VoxelRows:
    """Some rows of a grid as a table of their own."""

    def __init__(self, nodes: Nodes, density: Float[Tensor, "row 1"], harmonics: Float[Tensor, "row 27"]):
        self.nodes, self.density, self.harmonics = nodes, density, harmonics

    def at(
        self, places: Float[Tensor, "sample 3"], directions: Float[Tensor, "sample 3"]
    ) -> tuple[Float[Tensor, " sample"], Float[Tensor, "sample 3"]]:
        """Density and colour at coordinates, before activation."""
        harmonics = self.harmonics.view(-1, COEFFICIENTS, 3)
        return kernels.harmonic_grid(places * 0.5 + 0.5, directions, self.nodes, self.density[:, 0], harmonics)


def _of_corners(nodes: Bool[Tensor, "x y z"]) -> Bool[Tensor, "x_less y_less z_less"]:
    """Cells that have one of these nodes at a corner."""
    for axis in range(3):
        size = nodes.shape[axis] - 1
        nodes = nodes.narrow(axis, 0, size) | nodes.narrow(axis, 1, size)
    return nodes


def _nodes_of(cells: Bool[Tensor, "x y z"]) -> Int[Tensor, " node"]:
    """Numbers of the nodes at these cells' corners, rising."""
    for axis in range(3):
        wall = torch.zeros_like(cells.narrow(axis, 0, 1))
        cells = torch.cat([cells, wall], axis) | torch.cat([wall, cells], axis)
    return cells.flatten().nonzero()[:, 0]


def _resized(kept: Bool[Tensor, "x y z"], cells: Cells) -> Bool[Tensor, "x_new y_new z_new"]:
    """The cells of another grid that overlap a kept one."""
    for axis, size in enumerate(cells):
        old = kept.shape[axis]
        edges = torch.arange(size, device=kept.device) * old
        first, last = edges // size, (edges + old - 1) // size
        span = [
            kept.index_select(axis, (first + i).clamp(max=old - 1).minimum(last)) for i in range(-(-old // size) + 1)
        ]
        kept = torch.stack(span).any(0)
    return kept


def _arrays(nodes: Nodes) -> tuple[np.ndarray, np.ndarray]:
    return nodes.index.numpy(), nodes.rows.numpy()


def _rows_around(points: Float[Tensor, "sample 3"], nodes: Nodes):
    """Rows of each of the eight nodes around points, -1 where one has none."""
    cells = torch.tensor(nodes.index.shape, device=points.device) - 1
    cell = torch.minimum((points.clamp(0, 1) * cells).long(), cells - 1)
    for corner in range(8):
        x, y, z = (cell + torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2], device=points.device)).unbind(-1)
        yield nodes.index[x, y, z]


@njit(parallel=True, fastmath=True, cache=True)
def _mark(points, index, rows, marks):
    """Mark the rows around each point. Threads may meet at one row; they all write the same there."""
    n = len(points)
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        at, weights = np.empty(9, np.int64), np.empty(9, np.float32)
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            for k in range(corners(points, i, index, rows, at, weights)):
                marks[at[k]] = True
