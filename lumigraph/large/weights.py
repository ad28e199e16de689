"""Weights of blocks in a picture and at a point, and visibility (Tancik et al. 2022, Block-NeRF, section 4.3)."""

from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..camera.rays import Rendering
from ..composition import Placed
from ..files.ranges import Share, between
from ..method.capabilities import HasVisibility, can, needs

MIN_DISTANCE = 1e-6  # of a radius, to avoid division by zero
UNSEEN_WEIGHT = 1e-12  # factor on the weight of a block that does not see: if none sees, distance alone decides
PREVIEW_SIDE = 16  # pixels along the longer side of the picture that estimates a block's visibility
RAY_FRACTIONS = (0.125, 0.375, 0.625, 0.875)  # of the way to a pixel's surface, at which visibility is evaluated


@dataclass(frozen=True)
class Mixing:
    """Options for choosing the blocks of a picture and mixing them (section 4.3).

    by: "camera", inverse distance from the camera to the blocks' centres, one weight for all pixels (the paper's);
        "points", inverse distance from each pixel's visible point; "visibility", that of each pixel's visible point in
        a block's training photographs; "nearest", only the block with the nearest centre
    """

    by: Literal["camera", "points", "visibility", "nearest"] = "camera"
    power: Annotated[float, between(0.1, 64)] = 4.0  # p, section 4.3.2
    threshold: Share = 0.1  # mean visibility at which a block counts nothing; at twice that it counts fully
    most: Annotated[int, between(1, 1024)] = 3  # blocks in one picture


def inverse_distance(
    distance: Float[Tensor, "*place block"], radii: Float[Tensor, " block"], power: float, most: int
) -> Float[Tensor, "*place block"]:
    """w = (1 / d - 1 / r)^p within reach, d < r, and 0 beyond; 1 for the nearest block where none is in reach.

    The weights of section 4.3.2, d^-p, are those of large r. With r they fall to 0 where a block leaves the picture,
    instead of a jump (Franke 1980). r is the block's radius, or the distance of the block `most` + 1 nearest where that
    is less, so that no more than `most` have a weight.
    """
    count = distance.shape[-1]
    reach = radii.expand_as(distance)
    if most < count:
        inside = torch.where(distance < radii, distance, torch.inf)
        reach = torch.minimum(reach, inside.kthvalue(most + 1, -1, keepdim=True).values)
    inverse = 1 / torch.maximum(distance, MIN_DISTANCE * radii) - 1 / reach
    largest = inverse.amax(-1, keepdim=True).clamp_min(1e-12)
    weights = (inverse / largest).clamp_min(0) ** power  # a common factor, so that no power overflows
    alone = torch.nn.functional.one_hot(distance.argmin(-1), count).to(weights)
    return torch.where(weights.sum(-1, keepdim=True) > 0, weights, alone)


def seeing(visibility: Float[Tensor, "*place block"], threshold: float) -> Float[Tensor, "*place block"]:
    """Weights of blocks by their mean visibility (section 4.3.1): 0 up to a threshold, 1 from twice that on, so that no
    block disappears abruptly in a film."""
    return (visibility / max(threshold, UNSEEN_WEIGHT) - 1).clamp(UNSEEN_WEIGHT, 1)


def shares(weights: Float[Tensor, "*place block"]) -> Float[Tensor, "*place block"]:
    """Normalise weights to sum 1."""
    return weights / weights.sum(-1, keepdim=True)


@torch.no_grad()
def saw(part: Placed, camera: Camera, seen: Rendering) -> Float[Tensor, "height width"]:
    """Visibility of each pixel's point in the block's training photographs, in [0, 1]; 1 for a method without
    visibility.

    camera: in the picture's frame
    seen:   the part's rendering for it; at empty pixels the point is at the end of the block's frame
    """
    if not can(part.method, HasVisibility):
        return torch.ones_like(seen.depth)
    visibility = needs(part.method, HasVisibility).visibility
    local, scale = part.camera(camera), part.place.scale
    rays = local.rays(local.pixels())
    depth = (seen.depth.reshape(-1) / scale).clamp(max=part.method.frame.reach)
    found = [visibility(rays.at(share * depth), rays.directions) for share in RAY_FRACTIONS]
    return torch.stack(found).mean(0).view(seen.depth.shape)
