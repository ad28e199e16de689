"""Patches of pictures that nobody took: rays of cameras between the photographs' (Niemeyer 2022, section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ...camera import Camera
from ...camera.rays import Rays
from ...geometry import look_at, nearest_to_lines

ASTRAY = 0.125  # deviation of the point that an unseen camera looks at, of the distance to it (section 3.3)


def unseen_cameras(cameras: Camera, count: int, generator: torch.Generator) -> Camera:
    """Cameras that stand anywhere in the box around the given ones, upright as these are on average, and look at about
    the point that all of these look at, through the lens of one of them."""
    position, forward = cameras.position.cpu(), cameras.forward.cpu()
    low, high = position.amin(0), position.amax(0)
    focus = nearest_to_lines(position.double(), forward.double(), (position + forward).mean(0).double()).float()
    away = (focus - position).norm(dim=-1).mean()
    stand = low + torch.rand(count, 3, generator=generator) * (high - low)
    aim = focus + ASTRAY * away * torch.randn(count, 3, generator=generator)
    lent = cameras[torch.randint(len(cameras), (count,), generator=generator).to(cameras.pose.device)]
    pose = look_at(stand, aim - stand, -cameras.pose[:, :, 1].cpu().mean(0))
    return replace(lent, pose=pose.to(lent.pose), image_index=None)


def patches(cameras: Camera, side: int, strides: Sequence[int], generator: torch.Generator) -> Rays:
    """Rays of one square patch of each camera, row by row: side * side of them.

    strides: pixels between two rays of a patch; each patch has one of them, no larger than the picture allows
    """
    count, sizes = len(cameras), cameras.size.cpu()
    chosen = torch.tensor(strides)[torch.randint(len(strides), (count,), generator=generator)]
    stride = torch.minimum(chosen, (sizes.amin(-1) // side).clamp_min(1))[:, None]
    corner = torch.rand(count, 2, generator=generator) * (sizes - stride * (side - 1) - 1).clamp_min(0)
    rows, columns = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    steps = torch.stack([columns, rows], -1).view(-1, 2)
    pixels = corner.floor()[:, None] + 0.5 + steps * stride[:, None]
    index = torch.arange(count, device=cameras.pose.device).repeat_interleave(side * side)
    rays = cameras.rays(pixels.view(-1, 2).to(cameras.pose), index)
    wider = stride.expand(-1, side * side).flatten().to(rays.radius)
    return replace(rays, radius=rays.radius * wider)


def roughness(
    depth: Float[Tensor, "patch row column"], opacity: Float[Tensor, "patch row column"]
) -> Float[Tensor, ""]:
    """Squared difference of each two neighbouring depths of a patch, where both are opaque, mean of all pairs
    (Niemeyer 2022, eq. 6, which has no opacity: there everything is opaque)."""
    counts = opacity.detach()
    across = (depth[:, :, 1:] - depth[:, :, :-1]).square() * counts[:, :, 1:] * counts[:, :, :-1]
    down = (depth[:, 1:] - depth[:, :-1]).square() * counts[:, 1:] * counts[:, :-1]
    return 0.5 * (across.mean() + down.mean())
