"""Alpha compositing over a background (Porter and Duff 1984), for straight and premultiplied colours."""

import torch
from jaxtyping import Float
from torch import Tensor


def before(
    rgb: Float[Tensor, "*pixels 3"],
    alpha: Float[Tensor, "*pixels"] | None,
    background: Float[Tensor, "*#pixels 3"] | tuple[float, float, float],
) -> Float[Tensor, "*pixels 3"]:
    """Composite straight (not premultiplied) colours, as in photographs, over a background.

    alpha: None for opaque pictures
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
    """Composite premultiplied colours, as in renderings, over a background."""
    return light + (1 - opacity)[..., None] * background
