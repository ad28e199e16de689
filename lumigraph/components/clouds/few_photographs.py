"""What keeps a cloud of which few photographs tell from explaining each of them by itself.

Some Gaussians are left out of each step, so that those behind them learn too; and depth is asked to be smooth in
pictures that nobody took.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ...camera import Camera
from ...gaussians import Gaussians
from ...gaussians.splatting import splat, view_of
from ..training.fog import evened
from ..training.unseen_views import roughness, unseen_cameras

LEFT_OUT = 0.2  # share of Gaussians at the end of training, to which it grows evenly (Park 2025, section 3.2)
GONE = -30.0  # logit of an opacity that no picture shows
OPAQUEST = 0.999
SHORTER = 96  # pixels of the shorter side of a picture that nobody took


def some_left_out(cloud: Gaussians, share: float, generator: torch.Generator) -> Gaussians:
    """The cloud as a step sees it: a random share of its Gaussians is gone, and the others are as much more opaque,
    o / (1 - share), so that light gets as far on average (Park 2025, arXiv 2504.00773, eq. 4)."""
    there = (torch.rand(len(cloud), generator=generator) >= share).to(cloud.means.device)
    opacity = (cloud.opacities.sigmoid() / (1 - share)).clamp(max=OPAQUEST)
    return replace(cloud, opacities=torch.where(there, opacity.logit(), GONE))


def unseen_roughness(cloud: Gaussians, cameras: Camera, near: float, generator: torch.Generator) -> Float[Tensor, ""]:
    """How rough depth is in a small picture that nobody took (Niemeyer 2022, eq. 6, over the whole of it).

    cameras: of the photographs, between which it is taken;  near: the near plane
    """
    camera = unseen_cameras(cameras, 1, generator)
    camera = camera.resized(min(SHORTER / float(camera.size.min()), 1.0))
    seen = splat(cloud, view_of(camera, near), bands=1)
    place = evened(seen.depth / seen.opacity.clamp_min(1e-3))
    return roughness(place[None], seen.opacity[None])
