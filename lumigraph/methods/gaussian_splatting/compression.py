"""Compression of a cloud: importance of Gaussians, and a cloud without the least important ones."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from ...camera import Camera
from ...exchange.codes import morton_order
from ...exchange.packing import most_important
from ...gaussians import Gaussians
from ...gaussians.splatting import splat, view_of


def picture_share(cloud: Gaussians, camera: Camera, near: float) -> Float[Tensor, " gaussian"]:
    """Derivative of a picture's brightness in that of each Gaussian."""
    grey = torch.zeros(len(cloud), 1, 3, device=cloud.means.device, requires_grad=True)
    with torch.enable_grad():
        seen = splat(replace(cloud, harmonics=grey), view_of(camera, near), 1)
        (gain,) = torch.autograd.grad(seen.rgb.sum(), grey)
    return gain[:, 0].mean(-1)


def thinned(
    cloud: Gaussians, importance: Float[Tensor, " gaussian"], share: float
) -> tuple[Gaussians, Int[Tensor, " kept"]]:
    """The cloud without a share of its Gaussians, the least important ones, and indices of the others. They are in
    Morton order, where neighbours are alike, and each rotation is the quaternion with w >= 0."""
    kept = most_important(importance, 1 - share).nonzero()[:, 0]
    kept = kept[torch.from_numpy(morton_order(cloud.means[kept].detach().cpu().numpy()))]
    upright = normalize(cloud.quaternions, dim=-1)
    upright = torch.where(upright[:, :1] < 0, -upright, upright)
    return replace(cloud, quaternions=upright)[kept], kept
