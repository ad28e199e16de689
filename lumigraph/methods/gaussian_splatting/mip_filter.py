"""Mip-Splatting's filters: no Gaussian is finer than the photographs' sampling (Yu 2024, arXiv 2311.16493)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...camera import Camera
from ...components.clouds.addition import Addition, Step, TrainingViews
from ...components.clouds.cloud import Cloud
from ...gaussians import Gaussians
from ...gaussians.splatting import view_of

FILTER_VARIANCE = 0.2  # squared sampling intervals (section 6.1)


@dataclass(frozen=True)
class MipNumbers:
    """A Config's switches of Mip-Splatting."""

    antialiased: bool = False  # Mip-Splatting's 2-D filter (Yu 2024, section 5.2), for smaller pictures
    filter_3d: bool = False  # Mip-Splatting's 3-D filter (Yu 2024, section 5.1), for larger pictures


class MipFilter(Addition):
    """The 3-D filter.

    interval: sampling interval of each Gaussian, see `sampling_interval`
    """

    grows: ClassVar[tuple[str, ...]] = ("interval",)
    interval: Tensor

    def __init__(self, count: int):
        super().__init__()
        self.register_buffer("interval", torch.zeros(count))

    def begin_cloud(self, cloud: Cloud, views: TrainingViews, chance: torch.Generator) -> None:
        assert views.cameras is not None
        self.interval = sampling_interval(cloud.means, views.cameras, views.near_plane)

    def finish(self, step: Step) -> None:
        if step.due:
            self.begin_cloud(step.learnt, step.views, step.chance)

    def follow(self, source: Int[Tensor, " gaussian"]) -> None:
        self.interval = self.interval[source]

    def filtered(self, cloud: Gaussians) -> Gaussians:
        return convolved(cloud, self.interval)


@torch.no_grad()
def sampling_interval(means: Float[Tensor, "gaussian 3"], cameras: Camera, near: float) -> Float[Tensor, " gaussian"]:
    """Finest spacing, in scene units, at which a camera samples each place: depth over focal length (eq. 6).

    A place that no camera sees gets the coarsest spacing of the others.
    """
    finest = torch.full((len(means),), torch.inf, device=means.device)
    for i in range(len(cameras)):
        view = view_of(cameras[i], near).to(means.device)
        x, y, z = ((means - view.eye) @ view.rotation.T).unbind(-1)
        x_low, x_high, y_low, y_high = (view.limits[k] * z for k in range(4))
        seen = (z > view.near) & (x > x_low) & (x < x_high) & (y > y_low) & (y < y_high)
        finest = torch.where(seen, torch.minimum(finest, z / view.focal.max()), finest)
    known = finest.isfinite()
    coarsest = finest[known].max() if known.any() else finest.new_tensor(0.0)
    return torch.where(known, finest, coarsest)


def convolved(gaussians: Gaussians, interval: Float[Tensor, " gaussian"]) -> Gaussians:
    """The cloud convolved with the filter: wider, and fainter by as much (eq. 7)."""
    variance = (2 * gaussians.log_scales).exp()
    wider = variance + FILTER_VARIANCE * interval[:, None].square()
    share = (variance / wider).log().sum(-1).mul(0.5).exp()
    opacity = (gaussians.opacities.sigmoid() * share).clamp(1e-7, 1 - 1e-6)
    return replace(gaussians, log_scales=0.5 * wider.log(), opacities=opacity.logit())
