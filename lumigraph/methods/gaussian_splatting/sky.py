"""A sky for each photograph: the background as a smooth function of the direction.

Sky and weather change between photographs and must not become density in front of their cameras, where all other
photographs would see it. A sky by direction alone is Rematas 2022's (Urban Radiance Fields); its harmonics for each
photograph are those of Splatfacto-W (Xu 2024, arXiv 2407.12306).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ... import kernels
from ...camera import Camera
from ...datasets.scene import Photograph, Scene
from ...kernels.spherical_harmonics import K00

SKY_BANDS = 3  # of spherical harmonics
SKY_NUMBERS = 3 * SKY_BANDS**2  # of a photograph's code: the harmonics by rows, three colours each


def sky(code: Float[Tensor, " 27"], camera: Camera) -> Float[Tensor, "height width 3"]:
    """Sky colours at every pixel of one camera."""
    return sky_harmonics(camera) @ code.view(SKY_BANDS**2, 3)


def sky_harmonics(camera: Camera) -> Float[Tensor, "height width 9"]:
    """Values of the sky's harmonics at every pixel of one camera."""
    width, height = camera.size[0].tolist()
    directions = camera.rays(camera.pixels()).directions
    return kernels.spherical_harmonics(directions, SKY_BANDS).view(height, width, SKY_BANDS**2)


def sky_loss(
    background: Float[Tensor, "height width 3"], photograph: Photograph, opacity: Float[Tensor, "height width"]
) -> Float[Tensor, ""]:
    """Absolute error of a sky where pixels are masked out and nothing is opaque: a mask around an object says that its
    surroundings are not to be learnt, not that they may have any colour."""
    if photograph.mask is None:
        return background.new_zeros(())
    counts = (1 - opacity.detach()) * ~photograph.mask
    return (counts[..., None] * (background - photograph.rgb).abs()).mean()


@torch.no_grad()
def mean_skies(scene: Scene) -> Float[Tensor, "image 27"]:
    """Codes of a uniform sky in the mean colour of each training photograph; zeros for the others."""
    codes = torch.zeros(len(scene.cameras), SKY_NUMBERS)
    for index in scene.splits["train"].tolist():
        codes[index, :3] = scene.photograph(index).rgb.flatten(0, 1).mean(0) / K00
    return codes
