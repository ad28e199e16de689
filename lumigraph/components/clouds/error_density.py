"""Density control by error: Gaussians that explain the most error are divided, up to a number that rises to the cap."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...geometry import to_matrix
from .adaptive import AdaptiveDensity, add_copies, largest
from .addition import Step
from .cloud import GrowingCloud
from .density_control import PRUNE_OPACITY

HALF_SCALE = 1 / math.sqrt(2)  # of the longest axis of a divided Gaussian, in terms of its former deviation


class ErrorDensity(AdaptiveDensity):
    """Divide the Gaussians that explain the most error.

    A Gaussian explains its blending weight's share of the absolute error of each pixel, summed over the steps since the
    last change. Ranking by error and a number that is given beforehand are those of Mallick 2024
    (Taming 3DGS, arXiv 2406.15643) and Liao 2025 (LiteGS, arXiv 2503.01199).
    explained: error that each Gaussian explains
    """

    grows: ClassVar[tuple[str, ...]] = ("explained",)
    ramp: ClassVar[float] = 0.5  # most Gaussians come early, and have steps to converge
    explained: Tensor

    def follows_errors(self, progress: float) -> bool:
        return progress < self.refining.refine_until

    def note(self, step: Step) -> None:
        assert step.explained is not None and step.explained.grad is not None
        self.explained += step.explained.grad

    @torch.no_grad()
    def refine(self, cloud: GrowingCloud, extent: float, cap: int, generator: torch.Generator) -> bool:
        """Prune and divide. Returns whether the cap prevented some divisions."""
        kept = (cloud.opacities.sigmoid() >= PRUNE_OPACITY).nonzero()[:, 0]
        wanted = kept[self.explained[kept] > 0]
        chosen = largest(wanted, self.explained, cap - len(kept))
        halves, fresh = add_copies(cloud, kept, chosen, chosen)
        divide(cloud, halves, torch.where(fresh, -1.0, 1.0)[halves])
        self.explained.zero_()
        return len(chosen) < len(wanted)


def pixel_errors(step: Step) -> Float[Tensor, "height width"]:
    """Absolute error of each pixel, of the sum over the picture; none where pixels are left out."""
    error = (step.rgb - step.target).detach().abs().mean(-1)
    return error / error.numel()


@torch.no_grad()
def divide(cloud: GrowingCloud, halves: Bool[Tensor, " gaussian"], side: Float[Tensor, " half"]) -> None:
    """Move two copies of a Gaussian apart along its axes, and shrink them, in place.

    With deviations s_i and the longest one s,

        k_i = 1 - (1 - 1 / sqrt(2)) (s_i / s)^2      s_i' = k_i s_i      offset_i = side sqrt(1 - k_i^2) s_i

    The variance along each axis stays, and so does the sum of both opacities along a line where they are small.

    halves: the copies;  side: 1 or -1 for each of them
    """
    some = cloud.gaussians()[halves]
    scales = some.log_scales.exp()
    factors = 1 - (1 - HALF_SCALE) * (scales / scales.amax(-1, keepdim=True)).square()
    offset = side[:, None] * (1 - factors.square()).sqrt() * scales
    cloud.means[halves] += (to_matrix(some.quaternions) @ offset[:, :, None])[:, :, 0]
    cloud.log_scales[halves] += factors.log()
    faint = 1 - (1 - some.opacities.sigmoid()) ** HALF_SCALE
    cloud.opacities[halves] = faint.clamp(PRUNE_OPACITY, 1 - 1e-6).logit()
