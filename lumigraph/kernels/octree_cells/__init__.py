"""Octree traversal: the occupied cells that each ray crosses, with entry and exit distances."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Int32
from torch import Tensor

from ...camera.rays import Samples
from .._operation import Facts, door, implementation, require, using

FACTS = Facts(unit="rays", outputs=4, differentiable=(), typical=3, compiled=5)

MAX_LEVELS = 10  # levels: a code has three bits for each, and one more, in 32 bits
MIN_SPEED = 1e-9  # of a direction along an axis; slower ones are set to it


@dataclass(frozen=True)
class Tree:
    """Table row of each cell of an octree over the unit cube; made by `of` or `part`.

    A node is a cell with eight children. A cell's code begins with a 1 and has three bits for each level: its half
    along x, y and z (1 is the upper one).

    cells: the eight children of each node: k > 0 is node k; 0 is empty; -1 - r is a leaf with row r. The first node is
           the cube; child (x, y, z) of a node is at 4 x + 2 y + z
    rows:  int32; table row for each row that `cells` names, -1 for none, in a table of `count` rows; empty for identity
    depth: maximum number of levels below the cube
    """

    cells: Int32[Tensor, "node 8"]
    rows: Int32[Tensor, " row"]
    count: int
    depth: int

    @classmethod
    def of(cls, codes: Int[Tensor, " row"]) -> Tree:
        """Tree of leaf cells with these codes, each with the index of its code as row. Raises ValueError unless all
        differ and none contains another."""
        codes = codes.long()
        levels = levels_of(codes)
        depth = int(levels.max()) if len(codes) else 1
        sound = len(codes) == 0 or (int(codes.min()) >= 8 and int(codes.max()) < 8 ** (MAX_LEVELS + 1))
        require(sound, f"codes of cells have 1 to {MAX_LEVELS} levels")
        divided = [codes.new_ones(1)]  # codes of the nodes, level by level
        for level in range(1, depth):
            deeper = codes[levels > level] >> 3 * (levels[levels > level] - level)
            divided.append(torch.unique(deeper))
        cells = torch.zeros(sum(map(len, divided)), 8, dtype=torch.int32, device=codes.device)
        begin = 0
        for level, nodes in enumerate(divided):
            end = begin + len(nodes)
            if level + 1 < depth:
                below = divided[level + 1]
                parent = begin + torch.searchsorted(nodes, below >> 3)
                cells[parent, below & 7] = torch.arange(end, end + len(below), device=codes.device).int()
            rows = (levels == level + 1).nonzero()[:, 0]
            parent = begin + torch.searchsorted(nodes, codes[rows] >> 3).clamp(max=max(len(nodes) - 1, 0))
            there = nodes[parent - begin] == codes[rows] >> 3
            require(bool(there.all()) and bool((cells[parent, codes[rows] & 7] == 0).all()), "a cell lies in another")
            cells[parent, codes[rows] & 7] = (-1 - rows).int()
            begin = end
        require(int((cells < 0).sum()) == len(codes), "two rows belong to one cell")
        return cls(cells, cells.new_zeros(0), len(codes), depth)

    def part(self, rows: Int[Tensor, " some"]) -> Tree:
        """The same tree for a table of only these rows, in this order; its other cells are empty."""
        here = torch.full_like(self.named, -1)
        here[rows] = torch.arange(len(rows), dtype=torch.int32, device=rows.device)
        return Tree(self.cells, here, len(rows), self.depth)

    @property
    def named(self) -> Int32[Tensor, " row"]:
        """`rows`, with the identity written out."""
        return self.rows if len(self.rows) else torch.arange(self.count, dtype=torch.int32, device=self.cells.device)

    def to(self, device: torch.device | str) -> Tree:
        return Tree(self.cells.to(device), self.rows.to(device), self.count, self.depth)


@dataclass(frozen=True)
class Crossed:
    """Intervals of rays in cells, packed as in `Samples`, and the row of each cell."""

    t_start: Float[Tensor, " sample"]
    t_end: Float[Tensor, " sample"]
    ray_starts: Int[Tensor, " ray_plus_one"]
    rows: Int[Tensor, " sample"]

    @property
    def samples(self) -> Samples:
        return Samples(self.t_start, self.t_end, self.ray_starts)


@door
def octree_cells(
    origins: Float[Tensor, "ray 3"],
    directions: Float[Tensor, "ray 3"],
    tree: Tree,
    density: Float[Tensor, " row"],
    near: float = 0.0,
    stop: float = 0.0,
) -> Crossed:
    """Leaf cells with rows along each ray, in order, with entry and exit distances.

    Traversal is by integer cell coordinates: a ray leaves a cell through the side that it meets first, into the
    neighbour that contains its entry point. So rounding moves sides, but skips no cell.

    origins, directions, near: in units of the cube, which is [0, 1]^3; directions of unit length
    tree:    trusted to be unchanged since `of` or `part`
    density: per side of the cube, (tree.count,), for early termination
    stop:    cells behind exp(-sum of density times length) < stop are left out; 0 keeps all
    Not differentiable.
    """
    check(tree, density, near, stop)
    return Crossed(*implementation("octree_cells", origins)(origins, directions, tree, density, near, stop))


def check(tree: Tree, density: Tensor, near: float, stop: float) -> None:
    """Raise ValueError for inputs that a traversal cannot use."""
    require(len(density) == tree.count, f"{len(density)} densities, where a tree has {tree.count} rows")
    require(1 <= tree.depth <= MAX_LEVELS, f"a tree of {tree.depth} levels cannot be")
    require(near >= 0 and 0 <= stop <= 1, f"near {near} and stop {stop} cannot be")


def levels_of(codes: Int[Tensor, " row"]) -> Int[Tensor, " row"]:
    """Number of levels below the cube of cells with these codes."""
    level = torch.zeros_like(codes)
    for k in range(1, MAX_LEVELS + 1):
        level += (codes >= 8**k).to(level.dtype)
    return level


def cases(generator: torch.Generator):
    """Test inputs for all engines, without rays whose cells depend on rounding."""
    for rays, depth, share, near, stop in [
        (0, 1, 1.0, 0.0, 0.0),
        (1, 1, 1.0, 0.0, 0.0),
        (9, 2, 0.0, 0.0, 0.0),
        (30, 3, 0.6, 0.0, 0.0),
        (40, 2, 0.6, 0.7, 0.0),
        (30, 3, 0.8, 0.1, 0.2),
        (5, 6, 0.3, 0.0, 0.0),
    ]:
        tree = some_tree(depth, share, generator)
        origins, directions = some_rays(rays, generator)
        yield steady(origins, directions, tree, 6 * torch.rand(tree.count, generator=generator), near, stop)
    tree = some_tree(3, 0.5, generator)
    part = tree.part(torch.arange(tree.count - 1, -1, -3))
    origins, directions = some_rays(20, generator)
    yield steady(origins, directions, part, torch.rand(part.count, generator=generator), 0.0, 0.0)


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """size / 16 rays of neighbouring pixels through a ball's shell of cells of 1/128, with early termination."""
    tree = shell(7)
    origins, directions = picture(size // 16)
    return origins, directions, tree, 400 * torch.rand(tree.count, generator=generator), 0.0, 1e-3


def some_tree(depth: int, share: float, generator: torch.Generator) -> Tree:
    """A random tree: the share of cells that are divided, and of the others that have rows, in random order."""
    divided, codes = torch.ones(1, dtype=torch.int64), []
    for level in range(1, depth + 1):
        cells = (divided[:, None] * 8 + torch.arange(8)).flatten()
        further = torch.rand(len(cells), generator=generator) < (0.5 if level < depth else 0.0)
        further[: 1 if level < depth else 0] = True
        divided, others = cells[further][:64], cells[~further]
        codes.append(others[torch.rand(len(others), generator=generator) < share])
    every = torch.cat(codes)
    return Tree.of(every[torch.randperm(len(every), generator=generator)])


def some_rays(rays: int, generator: torch.Generator):
    """Rays from outside the cube and from inside it, some past it, some along the axes."""
    origins = 3 * torch.rand(rays, 3, generator=generator) - 1
    directions = torch.rand(rays, 3, generator=generator) - origins
    directions[: rays // 8] = torch.eye(3).repeat(rays // 24 + 1, 1)[: rays // 8]
    directions[rays // 8 : rays // 5] *= -1
    return origins, torch.nn.functional.normalize(directions, dim=-1)


def shell(depth: int) -> Tree:
    """The cells of one size that are at distances from 0.3 to 0.34 from the cube's middle."""
    place = (torch.arange(1 << depth) + 0.5) / (1 << depth) - 0.5
    radius = (place[:, None, None] ** 2 + place[:, None] ** 2 + place**2).sqrt()
    x, y, z = ((radius > 0.3) & (radius < 0.34)).nonzero().unbind(-1)
    return Tree.of(code_of(x, y, z, depth).sort()[0])


def picture(rays: int):
    """Rays of a square picture of the cube, row by row."""
    side = max(int(rays**0.5), 1)
    x = (torch.arange(side) + 0.5) / side - 0.5
    across = torch.stack([x.expand(side, side), x[:, None].expand(side, side)], -1).reshape(-1, 2)
    directions = torch.nn.functional.normalize(torch.cat([0.5 * across, torch.ones(len(across), 1)], -1), dim=-1)
    turn, _ = torch.linalg.qr(torch.tensor([[1.0, 0.4, 0.3], [-0.2, 1.0, 0.5], [0.1, -0.6, 1.0]]))
    return (0.5 - 2 * turn[:, 2]).expand(len(across), 3).contiguous(), directions @ turn.T


def code_of(x: Tensor, y: Tensor, z: Tensor, depth: int) -> Int[Tensor, " cell"]:
    """Codes of cells at a level from their integer coordinates."""
    code = torch.ones_like(x)
    for k in range(depth - 1, -1, -1):
        code = code * 8 + ((x >> k & 1) * 4 + (y >> k & 1) * 2 + (z >> k & 1))
    return code


def steady(origins: Tensor, directions: Tensor, tree: Tree, density: Tensor, near: float, stop: float):
    """The rays that cross the same cells when they move by more than float32 rounds."""

    def rows(nudge: float) -> tuple[Tensor, ...]:
        moved = origins.double() + nudge * torch.tensor([1.0, -0.7, 0.4])
        with using("reference"):
            found = octree_cells(moved, directions.double(), tree, density.double(), near, stop * (1 + 9 * nudge))
        return found.rows.split(found.ray_starts.diff().tolist())

    nudged = zip(*(rows(nudge) for nudge in (-1e-5, 0.0, 1e-5)), strict=True)
    keep = torch.tensor([torch.equal(a, b) and torch.equal(b, c) for a, b, c in nudged], dtype=torch.bool)
    return origins[keep], directions[keep], tree, density, near, stop
