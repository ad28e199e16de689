"""Background of an open scene in unobserved directions, from its own colours; and its floor, for camera limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..datasets.scene import Vector
from ..geometry import evenly
from ..method import Method

VIEWS, SIZE = 12, 96  # pictures that are looked at, and the longer side of each in pixels
MIN_OPAQUE_SHARE = 0.97  # share of them that must be opaque, or the scene's background is part of what it shows
HORIZON_BAND = math.sin(math.radians(10))  # of the horizon, above and below
MIN_SEEN_SHARE = 0.02  # share of pixels from which on something counts as seen
HAZE_SHARE, SKY_SHARE = 0.5, 0.5  # of the way to white, where no photograph shows a horizon or a sky
MAX_SHARE_BELOW_FLOOR = 0.02  # share of the surfaces in the box of interest that may lie below the floor


@dataclass(frozen=True)
class Backdrop:
    """sRGB-encoded colours overhead, at the horizon and underfoot; and the height of the floor, in scene units."""

    overhead: Vector
    horizon: Vector
    underfoot: Vector
    floor: float


@torch.no_grad()
def backdrop(method: Method, cameras: Camera) -> Backdrop | None:
    """Colours of sky, horizon and ground from some of the photographs' cameras.

    `None` for an object, and for a scene that is not opaque: its background belongs to the picture.
    """
    frame = method.frame
    if frame.has_alpha or not frame.is_open:
        return None
    colours, heights, opacities, places = [], [], [], []
    for i in evenly(range(len(cameras)), VIEWS):
        camera = cameras[i].to("cpu")
        camera = camera.resized(min(1.0, SIZE / int(camera.size.max())))
        seen, rays = method.render(camera), camera.rays(camera.pixels())
        depth = seen.depth.reshape(-1).cpu()
        solid = depth.isfinite()
        colours.append(seen.rgb.reshape(-1, 3).cpu().clamp(0, 1))
        heights.append(rays.directions[:, 2])
        opacities.append(seen.opacity.reshape(-1).cpu())
        places.append((rays.origins + depth[:, None] * rays.directions)[solid & (opacities[-1] > 0.5)])
    if (torch.cat(opacities) > 0.5).float().mean() < MIN_OPAQUE_SHARE:
        return None
    rgb, height, place = torch.cat(colours), torch.cat(heights), torch.cat(places)
    everything = torch.ones_like(height, dtype=torch.bool)
    underfoot = median(rgb, height < -HORIZON_BAND) or median(rgb, everything) or frame.background
    horizon = median(rgb, height.abs() < HORIZON_BAND) or lighter(underfoot, HAZE_SHARE)
    overhead = median(rgb, height > HORIZON_BAND) or lighter(horizon, SKY_SHARE)
    return Backdrop(overhead, horizon, underfoot, floor(place, torch.tensor(frame.bounds)))


def median(rgb: Float[Tensor, "pixel 3"], chosen: Tensor) -> Vector | None:
    """The colour in the middle of the chosen ones, channel by channel; None where they are few."""
    if chosen.float().mean() < MIN_SEEN_SHARE:
        return None
    red, green, blue = rgb[chosen].median(0).values.tolist()
    return red, green, blue


def lighter(colour: Vector, share: float) -> Vector:
    red, green, blue = (value + share * (1 - value) for value in colour)
    return red, green, blue


def floor(places: Float[Tensor, "point 3"], bounds: Float[Tensor, "2 3"]) -> float:
    """The height that nearly all surfaces above or below the box of interest's middle are above."""
    low, high = bounds
    near = places[((places >= low) & (places <= high))[:, :2].all(-1)]
    return float(near[:, 2].quantile(MAX_SHARE_BELOW_FLOOR)) if len(near) else float(low[2])
