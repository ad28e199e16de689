"""Marching through baked voxels in blocks, one voxel a step, and compositing them (Hedman 2021)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Int32
from torch import Tensor

from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="rays", outputs=2, differentiable=(5,), typical=5, compiled=9, smooth=(2, 3, 7))

CHANNELS = 8  # of a voxel: red, green, blue, alpha, four features
ALPHA = 3
MAX_VOXEL_DISTANCE = 6  # voxels; limit of a stored distance from an empty voxel to one that is not empty
MAX_BLOCK_DISTANCE = 64  # blocks; the same for empty blocks


@dataclass(frozen=True)
class Blocks:
    """Sparse voxel grid in blocks: table row of each voxel; made by `of`.

    Voxel (x, y, z) has its centre there. Block (a, b, c) has the voxels from (a, b, c) * block on and an apron of one
    voxel on each side, so that trilinear interpolation stays within one block.

    With a `ball` the voxels are in contracted coordinates (Barron 2022, eq. 10), h the ball's radius, c the centre of
    the grid, 4 h voxels wide: x is x inside the ball around c, and beyond it c + (2 - h / |x - c|) h (x - c) / |x - c|,
    so that all of space lies within 2 h of c.

    index: number of each block; or -d if it and its apron are empty, and so are all blocks fewer than d away
    rows:  table row of each voxel of each block; or -d if it is empty, and so are all voxels of that block that are
           fewer than d away along every axis
    count: number of rows
    ball:  radius in voxels of the uncontracted ball; 0 for no contraction
    """

    index: Int32[Tensor, "x y z"]
    rows: Int32[Tensor, "block side side side"]
    count: int
    ball: float = 0.0

    @classmethod
    def of(
        cls, places: Int[Tensor, "row 3"], shape: tuple[int, int, int], block: int, contracted: bool = False
    ) -> Blocks:
        """Blocks of voxels at these distinct coordinates in a grid of a shape, a cube if contracted. Raises ValueError
        for duplicates and for coordinates outside."""
        size = torch.tensor(shape, device=places.device)
        require(not contracted or len(set(shape)) == 1, f"what is contracted lies in a cube, and {shape} is none")
        require(bool(((places >= 0) & (places < size)).all()), f"places of voxels go from 0 below {shape}")
        blocks = (size + block - 1) // block
        require(block >= 1 and int(blocks.prod()) < 1 << 31, f"a grid cannot have {blocks.tolist()} blocks")
        which, own = torch.arange(len(places), device=places.device), places.long() // block
        for axis in range(3):  # a voxel at a block's side lies in its neighbour's apron too
            inside = places[which, axis].long() - block * own[:, axis]
            parts = [(which, own)]
            for at, step in ((0, -1), (block - 1, 1)):
                beyond = own[:, axis] + step
                again = ((inside == at) & (beyond >= 0) & (beyond < blocks[axis])).nonzero()[:, 0]
                moved = own[again]
                moved[:, axis] += step
                parts.append((which[again], moved))
            which, own = (torch.cat(column) for column in zip(*parts, strict=True))
        number = (own[:, 0] * blocks[1] + own[:, 1]) * blocks[2] + own[:, 2]
        there, number = torch.unique(number, return_inverse=True)
        index = torch.full((int(blocks.prod()),), -1, dtype=torch.int32, device=places.device)
        index[there] = torch.arange(len(there), dtype=torch.int32, device=places.device)
        side = block + 2
        rows = torch.full((len(there), side, side, side), -1, dtype=torch.int32, device=places.device)
        x, y, z = (places[which].long() - block * own + 1).unbind(-1)
        rows[number, x, y, z] = which.int()
        require(int((rows >= 0).sum()) == len(which), "two rows belong to one voxel")
        index = _with_distances(index.view(1, *blocks.tolist()), MAX_BLOCK_DISTANCE, beyond=False)[0]
        rows = _with_distances(rows, MAX_VOXEL_DISTANCE, beyond=True)  # beyond a block may be anything
        return cls(index, rows, len(places), shape[0] / 4 if contracted else 0.0)

    @property
    def block(self) -> int:
        """Voxels along a block's side, without the apron."""
        return self.rows.shape[1] - 2

    def to(self, device: torch.device | str) -> Blocks:
        return Blocks(self.index.to(device), self.rows.to(device), self.count, self.ball)


def _with_distances(rows: Int32[Tensor, "n x y z"], farthest: int, beyond: bool) -> Int32[Tensor, "n x y z"]:
    """Rows with Chebyshev distances to the nearest row at empty voxels. beyond: rows may be outside the array"""
    near = torch.nn.functional.pad(rows >= 0, (1,) * 6, value=beyond)
    far = torch.full_like(near, farthest, dtype=torch.int8)
    for distance in range(1, farthest):
        if near.all():
            break
        for axis in (1, 2, 3):
            wider, n = near.clone(), near.shape[axis]
            wider.narrow(axis, 1, n - 1).logical_or_(near.narrow(axis, 0, n - 1))
            wider.narrow(axis, 0, n - 1).logical_or_(near.narrow(axis, 1, n - 1))
            near = wider
        far[near & (far == farthest)] = distance
    return torch.where(rows >= 0, rows, -far[:, 1:-1, 1:-1, 1:-1].int())


@door
def block_march(
    origins: Float[Tensor, "ray 3"],
    directions: Float[Tensor, "ray 3"],
    enter: Float[Tensor, " ray"],
    leave: Float[Tensor, " ray"],
    blocks: Blocks,
    values: Float[Tensor, "row 8"],
    stop: float = 0.0,
) -> tuple[Float[Tensor, "ray 8"], Float[Tensor, " ray"]]:
    """Accumulate premultiplied values front to back, one voxel a step (Hedman 2021, section 5.2).

        t_i = enter + i, while t_i < leave      v_i: trilinear at o + t_i d, alpha_i one of its channels
        T_i = prod_{j<i} (1 - alpha_j)          transmittance; 0 once it is below `stop`

    In contracted blocks v_i is looked up at the contraction of o + t_i d, and the step of t_i is that of one contracted
    voxel: r / (h^2 s / r - cos), where r is the distance from the centre, cos that of the angle to the outward
    direction, h^2 s / r^2 the ray's speed in contracted voxels, s^2 = 1 + 4 (r sin / h)^2 (1 - h / r). To first order
    that is r^2 / (h^2 s); the rest makes it exact for radial rays.

    origins:      in voxels, centre of voxel (x, y, z) at (x, y, z); never contracted
    directions:   unit length
    enter, leave: distances of the first step and of the end, in voxels as origins
    blocks:       table row of each voxel, 0 where it has none; trusted to be unchanged since `of`
    values:       (blocks.count, 8): red, green, blue, alpha, four features, all but alpha multiplied by alpha

    Returns sum_i T_i v_i (R, 8), of which alpha's channel is the opacity, and sum_i T_i alpha_i t_i (R,).
    Both are differentiable in the values. A march of one step is a lookup at a point.
    """
    require(len(values) == blocks.count, f"{len(values)} rows of values, where blocks have {blocks.count}")
    return implementation("block_march", origins)(origins, directions, enter, leave, blocks, values, stop)


def cases(generator: torch.Generator):
    """Test inputs for all engines: none, haze, walls, several sizes of blocks, rays beside the grid."""
    for rays, shape, block, share, most, stop in [
        (0, (4, 4, 4), 2, 0.5, 0.5, 0.0),
        (1, (2, 2, 2), 2, 1.0, 0.5, 0.0),
        (5, (9, 5, 7), 3, 0.3, 0.3, 0.0),
        (3, (6, 6, 6), 6, 0.1, 1.0, 0.0),
        (9, (21, 11, 17), 5, 0.03, 0.7, 0.0),
        (20, (9, 8, 7), 4, 0.4, 0.9, 0.05),
        (3, (6, 6, 6), 4, 0.0, 0.9, 0.0),
    ]:
        yield _inputs(rays, shape, block, share, most, stop, generator)
    for rays, size, block, share, most, stop in [
        (4, 8, 3, 0.6, 0.4, 0.0),
        (33, 32, 4, 0.03, 0.7, 0.0),
        (20, 20, 5, 0.3, 0.5, 0.05),
    ]:
        yield _contracted(rays, size, block, share, most, stop, generator)


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """size / 64 rays through a shell in a grid of 256 voxels an axis, in blocks of 30."""
    place = torch.arange(256.0) - 127.5
    radius = (place[:, None, None] ** 2 + place[:, None] ** 2 + place**2).sqrt()
    places = ((radius > 90) & (radius < 94)).nonzero()
    origins, directions, enter, leave = _rays(size // 64, (256, 256, 256), generator)
    values = 0.3 * torch.rand(len(places), CHANNELS, generator=generator)
    return origins, directions, enter, leave, Blocks.of(places, (256, 256, 256), 30), values.requires_grad_(), 1e-3


def _inputs(rays, shape, block, share, most, stop, generator):
    total = shape[0] * shape[1] * shape[2]
    numbers = torch.randperm(total, generator=generator)[: int(share * total)]
    places = torch.stack(torch.unravel_index(numbers, shape), -1)
    values = most * torch.rand(len(places), CHANNELS, generator=generator)
    values[: len(places) // 8, ALPHA] = most
    return *_rays(rays, shape, generator), Blocks.of(places, shape, block), values, stop


def _contracted(rays, size, block, share, most, stop, generator):
    """Rays from inside the ball and around it, to far beyond; one that goes straight out."""
    numbers = torch.randperm(size**3, generator=generator)[: int(share * size**3)]
    places = torch.stack(torch.unravel_index(numbers, (size,) * 3), -1)
    values = most * torch.rand(len(places), CHANNELS, generator=generator)
    values[: len(places) // 8, ALPHA] = most
    middle, ball = (size - 1) / 2, size / 4
    origins = middle + ball * torch.randn(rays, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(rays, 3, generator=generator), dim=-1)
    origins[:1], directions[:1] = middle, torch.tensor([0.0, 0.0, 1.0])
    enter = torch.rand(rays, generator=generator)
    blocks = Blocks.of(places, (size,) * 3, block, contracted=True)
    return origins, directions, enter, torch.full((rays,), 9 * ball), blocks, values, stop


def _rays(count, shape, generator):
    """Rays from around a grid through it; one along an axis, one beside the grid."""
    size = torch.tensor(shape, dtype=torch.float32)
    out = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    target = size * (0.2 + 0.6 * torch.rand(count, 3, generator=generator)) - 0.5
    length = float(size.norm())
    directions = -out
    directions[:1] = torch.tensor([0.0, 0.0, 1.0])
    origins = target - length * directions
    origins[1:2] += 3 * length
    # Eighths and sixteenths, so that no engine's rounding decides how many steps there are.
    enter = (torch.randint(0, 8, (count,), generator=generator)) / 8 + length // 3
    return origins, directions, enter, enter + 2 * (length // 1) + 1 / 16
