"""Mip-Splatting's 3-D filter: no Gaussian finer than the photographs' sampling (Yu 2024, section 5.1)."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ...camera import Camera
from ...gaussians import Gaussians
from ...gaussians.splatting import view_of

VARIANCE = 0.2  # of the filter, in squared sampling intervals (section 6.1)


@torch.no_grad()
def sampling_interval(means: Float[Tensor, "gaussian 3"], cameras: Camera, near: float) -> Float[Tensor, " gaussian"]:
    """The finest spacing, in scene units, at which some camera samples each place: depth over focal length (eq. 6).

    A place that no camera sees gets the coarsest spacing that any other has.
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


def smoothed(gaussians: Gaussians, interval: Float[Tensor, " gaussian"]) -> Gaussians:
    """The cloud convolved with the filter: wider, and fainter by as much (eq. 7)."""
    variance = (2 * gaussians.log_scales).exp()
    wider = variance + VARIANCE * interval[:, None].square()
    share = (variance / wider).log().sum(-1).mul(0.5).exp()
    opacity = (gaussians.opacities.sigmoid() * share).clamp(1e-7, 1 - 1e-6)
    return replace(gaussians, log_scales=0.5 * wider.log(), opacities=opacity.logit())
