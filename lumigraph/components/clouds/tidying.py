"""Tidying: prune Gaussians close to a camera, clamp scale and anisotropy, zero unobserved harmonics."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...gaussians import Gaussians
from .addition import Addition, Step
from .cloud import zero_unobserved_sh

NEAR_ZONE = 2.5  # times the frame's near distance: up to there a Gaussian needs MIN_NEAR_VIEWS
MIN_NEAR_VIEWS = 3  # view count of a Gaussian in the near zone
MAX_SCALE = 0.5  # deviation, of the distance to the nearest camera
MAX_ANISOTROPY = 20.0  # ratio of the largest to the second deviation
MIN_ELONGATED_SCALE = 0.01  # deviation, of the cameras' extent, up to which anisotropy is not clamped
GAUSSIANS_PER_CHUNK = 1 << 14  # whose distances to all cameras are held at a time
PASSES_BEFORE_PRUNING = 2  # times that each photograph is learnt from before Gaussians are pruned


@dataclass(frozen=True)
class TidyingNumbers:
    """A Config's rules on Gaussians determined by few photographs. The paper has none of them."""

    prune_near: bool = False  # prune Gaussians close to a camera; off: they may hang before a lens
    limit_scale: bool = False  # clamp scales to half the distance to the nearest camera; off: giants may stay
    limit_anisotropy: bool = False  # clamp the largest scale to 20 times the second; off: needles may stay
    observed_harmonics: bool = False  # zero harmonics that too few photographs determine; off: any are learnt


ALL_RULES = TidyingNumbers(prune_near=True, limit_scale=True, limit_anisotropy=True, observed_harmonics=True)


class Tidying(Addition):
    """The rules of a Config, applied after each step or at density control."""

    def __init__(self, rules: TidyingNumbers):
        super().__init__()
        self.rules = rules

    @torch.no_grad()
    def finish(self, step: Step) -> None:
        cloud, views, cameras, rules = step.learnt, step.views, step.views.cameras, self.rules
        limits = rules.limit_scale, rules.limit_anisotropy
        if step.due and cameras is not None and (rules.prune_near or any(limits)):
            distance = camera_distance(cloud.means, views.refined(cameras).position.to(cloud.means.device))
            near = near_camera(distance, cloud.view_count, views.near)
            known = rules.prune_near and step.drawn >= PASSES_BEFORE_PRUNING * len(cameras)
            if known and near.any() and not near.all():
                cloud.prune(~near)
                distance = distance[~near]
            cloud.log_scales.copy_(clamped_scales(cloud.gaussians(), distance, float(cloud.extent), *limits))
        if step.bands > 1 and rules.observed_harmonics:
            zero_unobserved_sh(cloud.harmonics, cloud.view_bits)


def camera_distance(
    means: Float[Tensor, "gaussian 3"], positions: Float[Tensor, "camera 3"]
) -> Float[Tensor, " gaussian"]:
    """Distance of each centre to the nearest camera, in scene units, in any direction."""
    return torch.cat([torch.cdist(some, positions).amin(-1) for some in means.split(GAUSSIANS_PER_CHUNK)])


def near_camera(
    distance: Float[Tensor, " gaussian"], view_count: Int[Tensor, " gaussian"], near: float
) -> Bool[Tensor, " gaussian"]:
    """Gaussians too close to a camera: within the near distance, or in the near zone with a low view count.

    distance: to the nearest camera
    near:     near distance, `Frame.near`
    """
    return (distance < near) | ((distance < NEAR_ZONE * near) & (view_count < MIN_NEAR_VIEWS))


def clamped_scales(
    gaussians: Gaussians,
    distance: Float[Tensor, " gaussian"],
    extent: float,
    by_distance: bool = True,
    by_anisotropy: bool = True,
) -> Float[Tensor, "gaussian 3"]:
    """Log scales with the largest deviation at most MAX_SCALE times the distance to the nearest camera, and at most
    MAX_ANISOTROPY times the second, unless it is short.

    extent:                     of the cameras, in scene units
    by_distance, by_anisotropy: apply the first limit, the second one
    """
    log_scales = gaussians.log_scales
    longest = MAX_SCALE * distance if by_distance else torch.full_like(distance, torch.inf)
    if by_anisotropy:
        second = log_scales.sort(-1).values[:, 1].exp()
        longest = torch.minimum(longest, (MAX_ANISOTROPY * second).clamp_min(MIN_ELONGATED_SCALE * extent))
    return torch.minimum(log_scales, longest.clamp_min(1e-12).log()[:, None])
