"""Few views: regularisation of a cloud that is learnt from a handful of photographs.

Each step drops some Gaussians, so that those behind them learn too; depth is smooth in unobserved views; colours do not
depend on the direction, which would explain wrong depth away.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...camera import Camera
from ...components.training.regularizers import normalized_distance, roughness, unseen_cameras
from ...files.ranges import NonNegative
from ...gaussians import Gaussians
from ...gaussians.splatting import splat, view_of
from .addition import Addition, Step

MAX_DROP_RATE = 0.2  # share of Gaussians at the end of training, to which it grows evenly (Park 2025, section 3.2)
DROPPED_OPACITY = -30.0  # logit
MAX_OPACITY = 0.999
UNOBSERVED_PIXELS = 96  # along the shorter side of an unobserved view


@dataclass(frozen=True)
class FewViewNumbers:
    """A Config's numbers for few photographs."""

    few_views: bool = False  # for few photographs: dropout, smooth depth at unobserved views, plain colours
    depth_weight: NonNegative = 1.0  # weight of depth's roughness at unobserved views, with few_views; 0: off


class FewViews(Addition):
    """Dropout of Gaussians, depth smoothness at unobserved views, plain colours."""

    base_colours = True

    def __init__(self, depth_weight: float):
        super().__init__()
        self.depth_weight = depth_weight

    def before_raster(self, method: Any, step: Step) -> None:
        step.cloud = drop_gaussians(step.cloud, MAX_DROP_RATE * method.progress, step.chance)

    def regularize(self, method: Any, step: Step) -> None:
        if self.depth_weight and method.cameras is not None:
            rough = depth_roughness(step.whole, method.cameras, method.near_plane, step.chance)
            step.terms["depth"] = self.depth_weight * rough


def drop_gaussians(cloud: Gaussians, share: float, generator: torch.Generator) -> Gaussians:
    """The cloud without a random share of its Gaussians. The others are as much more opaque, o / (1 - share), so that
    light gets as far on average (Park 2025, arXiv 2504.00773, eq. 4)."""
    there = (torch.rand(len(cloud), generator=generator) >= share).to(cloud.means.device)
    opacity = (cloud.opacities.sigmoid() / (1 - share)).clamp(max=MAX_OPACITY)
    return replace(cloud, opacities=torch.where(there, opacity.logit(), DROPPED_OPACITY))


def depth_roughness(cloud: Gaussians, cameras: Camera, near: float, generator: torch.Generator) -> Float[Tensor, ""]:
    """Roughness of depth in a small unobserved view (Niemeyer 2022, eq. 6, over the whole of it).

    cameras: of the photographs, between which the view lies;  near: the near plane
    """
    camera = unseen_cameras(cameras, 1, generator)
    camera = camera.resized(min(UNOBSERVED_PIXELS / float(camera.size.min()), 1.0))
    seen = splat(cloud, view_of(camera, near), bands=1)
    place = normalized_distance(seen.depth / seen.opacity.clamp_min(1e-3))
    return roughness(place[None], seen.opacity[None])
