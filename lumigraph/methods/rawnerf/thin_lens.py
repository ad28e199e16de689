"""A lens with a width: what lies at one distance from the camera is sharp, all else is spread over a disc."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ...camera import Camera
from ...camera.rays import Rays

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
NARROWEST = 0.2  # cosine with the axis below which a ray is taken to be no flatter


def through_lens(camera: Camera, aperture: float, focus: float, count: int) -> Iterator[Rays]:
    """Rays of all pixels of a camera (a batch of one) through so many places of its lens, one place after the other.

    aperture: diameter of the lens, scene units
    focus:    distance along the optical axis at which all of a pixel's rays meet, scene units
    Places lie on a spiral that fills the disc evenly (Vogel 1979), turned for each pixel by a fixed amount of its own,
    so that few of them make grain rather than rings, and the same grain each time.
    """
    pixels = camera.pixels()
    rays = camera.rays(pixels)
    right, down, forward = camera.pose[0, :, :3].unbind(-1)
    meeting = rays.at(focus / (rays.directions @ forward).clamp_min(NARROWEST))
    turn = 2 * math.pi * grain(pixels)
    for k in range(count):
        radius, angle = 0.5 * aperture * math.sqrt((k + 0.5) / count), GOLDEN_ANGLE * k + turn
        place = radius * (angle.cos()[:, None] * right + angle.sin()[:, None] * down)
        origins = rays.origins + place
        yield replace(rays, origins=origins, directions=torch.nn.functional.normalize(meeting - origins, dim=-1))


def grain(pixels: Float[Tensor, "pixel 2"]) -> Float[Tensor, " pixel"]:
    """A number in [0, 1) for each pixel, unlike its neighbours' (interleaved gradient noise, Jimenez 2014)."""
    weights = torch.tensor([0.06711056, 0.00583715], dtype=torch.float64)
    return ((52.9829189 * ((pixels.double().cpu() @ weights) % 1)) % 1).to(pixels)
