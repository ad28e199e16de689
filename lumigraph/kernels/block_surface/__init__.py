"""Marching cubes over hashed blocks: triangles where signed distances are zero, with vertices shared across blocks."""

import itertools
from functools import cache

import torch
from jaxtyping import Float, Int, Int32
from torch import Tensor

from .._operation import Facts, door, implementation
from ..block_hash import new_table
from ..cast_blocks import a_ball

FACTS = Facts(unit="blocks", outputs=3, differentiable=(), typical=3, compiled=3)


@door
def block_surface(
    voxels: Float[Tensor, "block 512 channel"],
    blocks: Int32[Tensor, "block 3"],
    table: Int32[Tensor, " slot"],
    min_weight: float = 0.0,
) -> tuple[Float[Tensor, "vertex 3"], Float[Tensor, "vertex colour"], Int[Tensor, "face 3"]]:
    """Triangles of the zero level, anticlockwise seen from where it is positive (Lorensen and Cline 1987).

    A vertex lies on the edge between two voxels (i, j, k) of the lattice 8 block + (i, j, k) with weights above
    min_weight and distances D, E of which one is negative, at the share D / (D - E), and has the channels after the
    weight at that share, or those of the one voxel of the two whose colour is known. A cube of eight voxels above
    min_weight has the triangles of its 256 cases (`triangles`): on a face whose diagonals differ in sign, negative
    corners are apart, in both cubes alike, so that the surface has no gaps. Its vertices are in the order of block,
    voxel and axis, its faces in that of block and voxel; each vertex has a face.

    voxels: (distance, weight, channels from which vertices take theirs); table: of the blocks (`block_hash`). Trusted
    Not differentiable.
    """
    with torch.no_grad():
        vertices, values, faces = implementation("block_surface", voxels)(voxels, blocks, table, min_weight)
    used = torch.zeros(len(vertices), dtype=torch.bool, device=voxels.device)
    used[faces.flatten()] = True
    number = used.cumsum(0) - 1
    return vertices[used], values[used], number[faces.flatten()].view(-1, 3)


@cache
def triangles() -> tuple[tuple[tuple[int, int, int], ...], ...]:
    """Triangles of each of the 256 cases, by their edges.

    Bit c of a case is set if corner c = 4 i + 2 j + k of the cube is negative. Edge 3 c + axis goes from corner c,
    whose coordinate along that axis is 0, to the next. On each face of the cube a segment cuts off every run of
    negative corners; segments form loops, and loops are fanned into triangles.
    """
    return tuple(tuple(fan for loop in _loops(case) for fan in _fans(loop)) for case in range(256))


def _faces():
    """Corners of the cube's faces, anticlockwise seen from outside."""
    for axis, side in itertools.product(range(3), range(2)):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        turns = ((0, 0), (1, 0), (1, 1), (0, 1)) if side else ((0, 0), (0, 1), (1, 1), (1, 0))
        yield [side << (2 - axis) | a << (2 - u) | b << (2 - v) for a, b in turns]


def _edge(one: int, other: int) -> int:
    return 3 * min(one, other) + {4: 0, 2: 1, 1: 2}[one ^ other]


def _loops(case: int) -> list[list[int]]:
    """Loops of edges around the negative corners of a case."""
    follows = {}
    for face in _faces():
        negative = [bool(case >> corner & 1) for corner in face]
        for first in range(4):
            if negative[first] and not negative[first - 1]:
                last = next(i for i in range(first, first + 4) if not negative[(i + 1) % 4])
                begin = _edge(face[first - 1], face[first])
                follows[_edge(face[last % 4], face[(last + 1) % 4])] = begin
    loops = []
    while follows:
        loop = [first := min(follows)]
        while (edge := follows.pop(loop[-1])) != first:
            loop.append(edge)
        loops.append(loop)
    return loops


def _fans(loop: list[int]) -> list[tuple[int, int, int]]:
    return [(loop[0], loop[i + 1], loop[i]) for i in range(1, len(loop) - 1)]


@cache
def case_table(device: str = "cpu") -> tuple[Tensor, Tensor]:
    """Triangles of each case as (case, triangle, 3) edges, and the number of triangles of each."""
    every = triangles()
    out = torch.zeros(256, max(map(len, every)), 3, dtype=torch.int32)
    for case, fans in enumerate(every):
        out[case, : len(fans)] = torch.tensor(fans, dtype=torch.int32).view(-1, 3)
    return out.to(device), torch.tensor([len(fans) for fans in every], dtype=torch.int32, device=device)


def cases(generator: torch.Generator):
    """Test inputs for all engines: no block, one, a ball in scattered blocks, every case of a cube."""
    for count, reach, least in [(0, 1, 0.0), (1, 1, 0.0), (3, 1, 0.5), (4, 1, 0.0)]:
        yield *a_ball(count, reach, generator), least
    voxels, blocks, table = a_ball(3, 1, generator)
    voxels = voxels.clone()
    voxels[..., 0] = torch.rand(voxels.shape[:2], generator=generator) - 0.5
    voxels[..., 1] = 2 * torch.rand(voxels.shape[:2], generator=generator)
    yield voxels, blocks, table, 0.3
    yield voxels[..., :2], blocks, table, 0.3


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """A ball in a cube of blocks, about size / 2 voxels."""
    reach = max(round((size / 1024) ** (1 / 3) / 2), 1)
    voxels, blocks, _ = a_ball((2 * reach) ** 3, reach, generator)
    return voxels, blocks, new_table(blocks), 0.0
