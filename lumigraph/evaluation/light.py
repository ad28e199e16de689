"""Views against light that is known without noise (Mildenhall 2022, section 5.1): what was photographed raw is compared
as light, for how a picture of it is developed is a matter of taste."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera.rays import Rendering
from ..components.fields.development import decoded, encoded

LIGHT_LAYER = "radiance"  # the layer that holds it, 1 for white
PROTOCOL = (
    "sRGB of light without noise, clipped at white; each rendering's linear light is aligned with it by a factor and "
    "an offset per colour, least squares, before both are encoded"
)

Picture = Float[Tensor, "height width 3"]


def in_light(seen: Rendering, truth: Picture) -> tuple[Picture, Picture]:
    """A rendering and the truth as pictures that can be compared, encoded in [0, 1].

    Where the rendering holds no light of its own (`radiance`), its picture is decoded.
    """
    light = seen.extra[LIGHT_LAYER] if LIGHT_LAYER in seen.extra else decoded(seen.rgb.clamp(0, 1))
    truth = truth.clamp(0, 1)
    return encoded(aligned(light.clamp(0, 1), truth).clamp(0, 1)), encoded(truth)


def aligned(light: Picture, truth: Picture) -> Picture:
    """a · light + b of each colour, with a and b that bring it nearest to the truth."""
    x, y = light.double(), truth.double()
    mean_x, mean_y = x.mean((0, 1)), y.mean((0, 1))
    variance = (x - mean_x).square().mean((0, 1))
    slope = ((x - mean_x) * (y - mean_y)).mean((0, 1)) / variance.clamp_min(1e-12)
    return torch.addcmul(mean_y, slope, x - mean_x).float()
