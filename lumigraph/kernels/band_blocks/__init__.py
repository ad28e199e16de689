"""Allocation: voxel blocks in the truncation band of a depth map that are not in the hash table yet."""

import math

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from .._operation import Facts, door, implementation, require
from ..block_hash import new_table, random_blocks

FACTS = Facts(unit="pixels", unit_axes=2, outputs=1, differentiable=(), typical=3, compiled=3)

STEPS_PER_SIDE = 2  # places on a ray to a side of a block


@door
def band_blocks(
    depth: Float[Tensor, "height width"],
    pose: Float[Tensor, "3 4"],
    lens: Float[Tensor, " 4"],
    blocks: Int32[Tensor, "block 3"],
    table: Int32[Tensor, " slot"],
    side: float,
    truncation: float,
) -> Int32[Tensor, "new 3"]:
    """Coordinates floor(p / side) of the blocks at points p along each pixel's ray (Nießner 2013, sec. 4.2),

        p = o + t d,    t = depth - truncation ... depth + truncation,   at least two points per block side

    that are missing from the table; each once, sorted by x, y, z.

    depth: along rays; pixels that are not finite or not positive have no blocks
    pose:  camera-to-world, OpenCV axes; lens: of a pinhole, focal lengths and centre (fx, fy, cx, cy) in pixels
    table: of the blocks (`block_hash`); trusted
    Not differentiable.
    """
    require(side > 0 and 0 < truncation < math.inf, f"side {side} and truncation {truncation} cannot be")
    steps = math.ceil(2 * truncation / side * STEPS_PER_SIDE)
    run = implementation("band_blocks", depth)
    return run(depth, pose, lens, blocks, table, side, truncation, steps)


def hand_held(generator: torch.Generator) -> tuple[Float[Tensor, "3 4"], Float[Tensor, " 4"]]:
    """Pose and lens of a camera near the origin, for tests."""
    axes = torch.linalg.qr(torch.eye(3) + 0.3 * torch.randn(3, 3, generator=generator))[0]
    axes = axes * torch.sign(axes.diagonal())
    return torch.cat([axes, 0.1 * torch.randn(3, 1, generator=generator)], 1), torch.tensor([20.0, 22.0, 8.2, 5.9])


def wall(height: int, width: int, generator: torch.Generator) -> Float[Tensor, "height width"]:
    """Depth of a wavy wall with a step and some holes, for tests."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    depth = 1.3 + 0.1 * (0.3 * x).sin() + 0.05 * (0.4 * y).cos() + 0.02 * torch.rand(height, width, generator=generator)
    depth = torch.where(x > 2 * width // 3, depth - 0.4, depth)
    holes = torch.rand(height, width, generator=generator)
    depth[holes < 0.05] = torch.nan
    depth[holes > 0.97] = torch.inf
    return depth


def cases(generator: torch.Generator):
    """Test inputs for all engines: no pixel, depth without values, blocks that the table has already."""
    for height, width, held, side, truncation in [
        (0, 5, 3, 0.2, 0.1),
        (1, 1, 0, 0.1, 0.1),
        (7, 9, 0, 0.05, 0.2),
        (12, 16, 500, 0.13, 0.15),
        (12, 16, 800, 0.31, 0.05),
    ]:
        blocks = random_blocks(held, 7, generator)
        yield wall(height, width, generator), *hand_held(generator), blocks, new_table(blocks), side, truncation
    depth, (pose, lens), blocks = torch.full((3, 4), torch.nan), hand_held(generator), random_blocks(9, 3, generator)
    yield depth, pose, lens, blocks, new_table(blocks), 0.1, 0.1
    yield -wall(3, 4, generator), pose, lens, blocks, new_table(blocks), 0.1, 0.1


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """A wall in a depth map of size / 4 pixels, with 500 blocks in the table."""
    side = max(round((size / 4) ** 0.5), 1)
    depth, (pose, _), blocks = wall(side, side, generator), hand_held(generator), random_blocks(500, 7, generator)
    lens = torch.tensor([side * 0.9, side * 0.9, side / 2, side / 2])
    return depth, pose, lens, blocks, new_table(blocks), 0.05, 0.03
