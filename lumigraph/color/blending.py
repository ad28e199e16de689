"""Colours before a background (Porter and Duff 1984): the one place where alpha meets what lies behind."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def before(
    rgb: Float[Tensor, "*pixels 3"],
    alpha: Float[Tensor, "*pixels"] | None,
    background: Float[Tensor, "*#pixels 3"] | tuple[float, float, float],
) -> Float[Tensor, "*pixels 3"]:
    """Colours that are not multiplied by alpha, as photographs have them, with a background behind what is not opaque.

    alpha: None where all is opaque
    """
    if alpha is None:
        return rgb
    behind = background if isinstance(background, Tensor) else torch.tensor(background, device=rgb.device)
    return behind + alpha[..., None] * (rgb - behind)


def over(
    light: Float[Tensor, "*pixels channel"],
    opacity: Float[Tensor, "*pixels"],
    background: Float[Tensor, "*#pixels channel"],
) -> Float[Tensor, "*pixels channel"]:
    """Light that was stopped on its way, as renderings have it (colours times opacity), and what passes from behind."""
    return light + (1 - opacity)[..., None] * background
