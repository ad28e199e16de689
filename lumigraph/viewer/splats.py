"""Gaussians as the browser draws them. It takes one colour for each and no spherical harmonics, so the colours are
those seen from one place, and are computed again where the camera comes to rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .. import kernels
from ..gaussians import Gaussians
from ..geometry import to_matrix, unit

# The browser's covariances are half-precision numbers: in units this much smaller, what is fine keeps its shape.
UNIT_SCALE = 16.0
MAX_SCALE = 250.0  # standard deviation in those units; its square still is a half-precision number


@dataclass(frozen=True)
class BrowserSplats:
    """Arrays that viser sends to the browser, with lengths multiplied by UNIT_SCALE."""

    centres: Float[np.ndarray, "gaussian 3"]
    covariances: Float[np.ndarray, "gaussian 3 3"]
    colours: Float[np.ndarray, "gaussian 3"]
    opacities: Float[np.ndarray, "gaussian 1"]


@torch.no_grad()
def splats(cloud: Gaussians, eye: Float[Tensor, " 3"]) -> BrowserSplats:
    """A cloud for the browser, coloured as seen from an eye; both in the scene's frame."""
    deviations = (UNIT_SCALE * cloud.log_scales.detach().exp()).clamp_max(MAX_SCALE)
    axes = to_matrix(cloud.quaternions.detach()) * deviations[:, None, :]
    return BrowserSplats(
        (UNIT_SCALE * cloud.means.detach()).cpu().numpy(),
        (axes @ axes.mT).cpu().numpy(),
        colours(cloud, eye).cpu().numpy(),
        cloud.opacities.detach().sigmoid()[:, None].cpu().numpy(),
    )


@torch.no_grad()
def colours(cloud: Gaussians, eye: Float[Tensor, " 3"]) -> Float[Tensor, "gaussian 3"]:
    """Colour of each Gaussian seen from one place, in [0, 1] (Kerbl 2023; the constant is that of `Gaussians`)."""
    directions = unit(cloud.means.detach() - eye.to(cloud.means))
    values = kernels.spherical_harmonics(directions, cloud.degree + 1)
    return (0.5 + torch.einsum("nk,nkc->nc", values, cloud.harmonics.detach())).clamp(0, 1)
