"""Visibility of what a block renders to its own photographs (Tancik et al. 2022, Block-NeRF, section 4.3.1)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..camera.rays import Rendering
from ..composition import Placed
from ..method.capabilities import HasVisibility, can, needs

PREVIEW_SIDE = 16  # pixels along the longer side of the picture that estimates a block's visibility
RAY_FRACTIONS = (0.125, 0.375, 0.625, 0.875)  # of the way to a pixel's surface, at which visibility is evaluated


@torch.no_grad()
def saw(part: Placed, camera: Camera, seen: Rendering) -> Float[Tensor, "height width"]:
    """Share of the way to what each pixel shows that the block's photographs saw, in [0, 1]; 1 for a method that does
    not know.

    camera: in the picture's frame
    seen:   what the part rendered for it; where nothing is, the way goes to the end of the block's frame
    """
    if not can(part.method, HasVisibility):
        return torch.ones_like(seen.depth)
    visibility = needs(part.method, HasVisibility).visibility
    local, scale = part.camera(camera), part.place.scale
    rays = local.rays(local.pixels())
    depth = (seen.depth.reshape(-1) / scale).clamp(max=part.method.frame.reach)
    found = [visibility(rays.at(share * depth), rays.directions) for share in RAY_FRACTIONS]
    return torch.stack(found).mean(0).view(seen.depth.shape)
