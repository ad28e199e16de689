"""Colours against photographs: what lies behind rays while a method learns, and by how much what it sees is wrong."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import huber_loss

from ...camera.rays import Rendering
from ...datasets.scene import Batch
from .exposure import Exposure


def backdrop(
    batch: Batch, background: Float[Tensor, "1 3"], generator: torch.Generator, opaque: bool = False
) -> Float[Tensor, "#ray 3"]:
    """The colours behind a batch's rays: the scene's own, or where photographs have alpha a random one for each ray, so
    that only opacity can imitate opacity.

    opaque: every ray ends at something. Random colours behind it then keep thin fog before black from passing for what
            is dark, and before white for what is bright
    """
    if batch.alpha is None and not opaque:
        return background
    return torch.rand(len(batch), 3, generator=generator).to(background.device)


def residuals(
    rendering: Rendering, batch: Batch, background: Float[Tensor, "#ray 3"], exposure: Exposure | None = None
) -> tuple[Float[Tensor, "row 3"], float]:
    """What a rendering before a background has too much of each colour, and the mean square of that.

    Where photographs have alpha, as many rows again say the same before the opposite colours, 1 - background, where
    only what opacity lacks looks different; they are not in the mean.
    exposure: gains of the photographs, which are the scene's and not the background's
    """
    rgb = rendering.rgb
    if exposure and batch.rays.image_index is not None:
        behind = (1 - rendering.opacity)[:, None] * background
        rgb = exposure(rgb - behind, batch.rays.image_index) + behind
    residual = rgb - batch.before(background)
    mse = float(residual.detach().square().mean())
    if batch.alpha is not None:
        lacking = (batch.alpha - rendering.opacity)[:, None]
        residual = torch.cat([residual, residual + lacking * (1 - 2 * background)])
    return residual, mse


def huber(residual: Float[Tensor, "row 3"], delta: float) -> Float[Tensor, ""]:
    """The mean of residuals' Huber loss, divided by delta, so that the linear part has slope 1."""
    return huber_loss(residual, torch.zeros_like(residual), delta=delta) / delta
