"""Integration: truncated signed distances and colours of voxels in blocks, averaged over depth maps."""

import math

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from .._operation import Facts, door, implementation, require
from ..band_blocks import band_blocks, hand_held, wall
from ..block_hash import SIDE, VOXELS, new_table

FACTS = Facts(unit="blocks", outputs=1, differentiable=(), typical=3, compiled=3)

CHANNELS = 5  # of a voxel: distance over truncation, weight, red, green, blue
UNCOLOURED = -1.0  # red of a voxel whose colour no depth map has shown
BEHIND_DEPTH = 1e-6  # along the axis, up to which a voxel is behind the camera


@door
def fuse_depth(
    voxels: Float[Tensor, "block 512 5"],
    blocks: Int32[Tensor, "block 3"],
    depth: Float[Tensor, "height width"],
    rgb: Float[Tensor, "height width 3"],
    trust: Float[Tensor, "height width"],
    pose: Float[Tensor, "3 4"],
    lens: Float[Tensor, " 4"],
    voxel: float,
    truncation: float,
    edge: float,
    max_weight: float = math.inf,
    growth: float = 0.0,
    in_place: bool = False,
) -> Float[Tensor, "block 512 5"]:
    """Voxels (distance D, weight W, colour) after integrating a depth map (Curless and Levoy 1996, eq. 3 and 4).

        d = min((depth - |p - o|) / truncation, r)     D <- (W D + w d) / (W + w)     W <- min(W + w, max_weight)

    for voxels at p = voxel (8 block + (i, j, k)) inside the picture, where d >= -r and w > 0; others stay. The band
    widens with depth, r = 1 + growth depth / truncation. Depth, colour and weight w = trust are interpolated between
    the four pixels around a voxel's projection. Where their depths differ by more than `edge` times the least, at a
    depth edge, and where one of them is unknown (not finite or not positive), the nearest known one of the four is
    taken. The colour is averaged likewise, but only over voxels within the band, |d| < r; red is UNCOLOURED before the
    first.

    voxels:   [block, (i, j, k) with k fastest, channel]
    depth:    along rays; pose: camera-to-world, OpenCV axes; lens: of a pinhole, (fx, fy, cx, cy) in pixels
    in_place: change `voxels`, of which there may be gigabytes, instead of a copy
    Not differentiable.
    """
    require(voxel > 0 and 0 < truncation < math.inf, f"voxel {voxel} and truncation {truncation} cannot be")
    require(0 <= growth < math.inf, f"a truncation cannot grow by {growth} of the depth")
    require(not in_place or voxels.is_contiguous(), "voxels to be changed in place must be contiguous")
    with torch.no_grad():
        out = voxels if in_place else voxels.clone(memory_format=torch.contiguous_format)
        if depth.numel():
            given = depth, rgb, trust, pose, lens, voxel, truncation, edge, max_weight, growth
            implementation("fuse_depth", voxels)(out, blocks, *given)
    return out


def empty_voxels(count: int, device: torch.device | str = "cpu") -> Float[Tensor, "block 512 5"]:
    """Voxels of blocks without observations."""
    fresh = torch.tensor([1.0, 0.0, UNCOLOURED, UNCOLOURED, UNCOLOURED], device=device)
    return fresh.expand(count, VOXELS, CHANNELS).contiguous()


def cases(generator: torch.Generator):
    """Test inputs for all engines: no block, no pixel, blocks beside and behind the view, voxels with observations."""
    for height, width, side, most in [(0, 4, 0.2, 9.0), (1, 1, 0.1, 9.0), (6, 5, 0.3, 2.5), (12, 16, 0.23, 2.0)]:
        yield _inputs(height, width, side, most, generator)
    voxels, blocks, *rest = _inputs(6, 8, 0.2, math.inf, generator)
    yield voxels[:0], blocks[:0], *rest
    yield voxels, -blocks, *rest  # behind


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """The blocks around a wall in a depth map of size / 4 pixels."""
    side = max(round((size / 4) ** 0.5), 1)
    return _inputs(side, side, 0.08, 64.0, generator)


def _inputs(height, width, side, most, generator):
    """A wall, blocks around it and others, half of the voxels observed; no input depends on rounding."""
    pose, _ = hand_held(generator)
    lens = torch.tensor([width * 1.1 + 0.1, width * 1.2 + 0.1, width / 2 + 0.03, height / 2 - 0.07])
    depth, truncation = wall(height, width, generator), side / 2
    nothing = torch.zeros(0, 3, dtype=torch.int32)
    blocks = band_blocks(depth, pose, lens, nothing, new_table(nothing), side, truncation)
    blocks = blocks[:: max(len(blocks) // 12, 1)]
    blocks = torch.cat([blocks, blocks + torch.tensor([0, 0, 40], dtype=torch.int32)])
    voxels = empty_voxels(len(blocks))
    seen = torch.rand(len(blocks), VOXELS, generator=generator) < 0.5
    known = torch.rand(len(blocks), VOXELS, CHANNELS, generator=generator)
    voxels = torch.where(
        seen[..., None], known * torch.tensor([2.0, 3.0, 1, 1, 1]) - torch.tensor([1.0, 0, 0, 0, 0]), voxels
    )
    voxels[:, ::5, 2:] = UNCOLOURED  # seen as free space alone
    rgb, trust = torch.rand(height, width, 3, generator=generator), torch.rand(height, width, generator=generator)
    trust[torch.rand(height, width, generator=generator) < 0.1] = 0
    inputs = voxels, blocks, depth, rgb, trust, pose, lens, side / SIDE, truncation, 0.15, most, 0.1 * truncation
    return _steady(*inputs)


def _steady(voxels, blocks, depth, rgb, trust, pose, lens, *numbers):
    """The inputs without blocks in which a voxel changes much when the camera moves by 1e-6."""
    if not len(blocks) or not depth.numel():
        return voxels, blocks, depth, rgb, trust, pose, lens, *numbers
    run = implementation("fuse_depth", voxels)
    steady = torch.ones(len(blocks), dtype=torch.bool)
    for shift in (-1e-6, 1e-6):
        moved = []
        for given in (pose, pose + shift):
            run(
                out := voxels.clone(), blocks, depth, rgb, trust, given, lens * (1 + given[0, 3] - pose[0, 3]), *numbers
            )
            moved.append(out)
        steady &= ((moved[0] - moved[1]).abs() < 1e-3).flatten(1).all(-1)
    return voxels[steady], blocks[steady], depth, rgb, trust, pose, lens, *numbers
