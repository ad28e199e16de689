"""A sky for each photograph: what shows behind everything, smooth in the direction.

Weather is no thing that stands somewhere. Without a backdrop of its own each photograph would hang its clouds in the
air before its camera, and every other would see them there. A sky by direction alone is Rematas 2022's (Urban Radiance
Fields); harmonics of it for each photograph are those of Splatfacto-W (Xu 2024, arXiv 2407.12306).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ... import kernels
from ...camera import Camera
from ...datasets.scene import Photograph, Scene

BANDS = 3  # of spherical harmonics
NUMBERS = 3 * BANDS**2  # of a photograph's code: the harmonics by rows, three colours each
CONSTANT = 0.28209479177387814  # Y_0 of the spherical harmonics


def sky(code: Float[Tensor, " 27"], camera: Camera) -> Float[Tensor, "height width 3"]:
    """The colours behind every pixel of one camera."""
    return harmonics(camera) @ code.view(BANDS**2, 3)


def harmonics(camera: Camera) -> Float[Tensor, "height width 9"]:
    """The harmonics behind every pixel of one camera."""
    width, height = camera.size[0].tolist()
    directions = camera.rays(camera.pixels()).directions
    return kernels.spherical_harmonics(directions, BANDS).view(height, width, BANDS**2)


def backdrop_loss(
    behind: Float[Tensor, "height width 3"], photograph: Photograph, opacity: Float[Tensor, "height width"]
) -> Float[Tensor, ""]:
    """How far a sky is from a photograph where pixels are not trusted and nothing stands: a mask around a thing says
    that its surroundings are not to be learnt, not that any colour will do behind it."""
    if photograph.mask is None:
        return behind.new_zeros(())
    counts = (1 - opacity.detach()) * ~photograph.mask
    return (counts[..., None] * (behind - photograph.rgb).abs()).mean()


@torch.no_grad()
def mean_skies(scene: Scene) -> Float[Tensor, "image 27"]:
    """Codes of an even sky, as bright as each training photograph on average; zeros for the others."""
    codes = torch.zeros(len(scene.cameras), NUMBERS)
    for index in scene.splits["train"].tolist():
        codes[index, :3] = scene.photograph(index).rgb.flatten(0, 1).mean(0) / CONSTANT
    return codes
