"""Tidying a cloud that learns: nothing hangs before a lens, no giants where cameras move, no needles."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...gaussians import Gaussians

CLOSE = 2.5  # times the frame's near distance, about where the nearest thing is: closer than that takes witnesses
WITNESSES = 3  # photographs that must have seen something so close
GIANT = 0.5  # of the distance to the nearest camera: the largest deviation
NEEDLE = 20.0  # times its second axis: how long a Gaussian may be
LONG = 0.01  # of the cameras' extent: a needle that is shorter may be as thin as it likes
CHUNK = 1 << 14  # Gaussians whose distances to all cameras are held at a time


def nearest_camera(
    means: Float[Tensor, "gaussian 3"], positions: Float[Tensor, "camera 3"]
) -> Float[Tensor, " gaussian"]:
    """Distance of each centre to the camera that is nearest, in scene units, whichever way it looks."""
    return torch.cat([torch.cdist(some, positions).amin(-1) for some in means.split(CHUNK)])


def before_a_lens(
    distance: Float[Tensor, " gaussian"], seen_by: Int[Tensor, " gaussian"], near: float
) -> Bool[Tensor, " gaussian"]:
    """What hangs before a camera: nearer than anything is, or nearly so and seen by hardly any photograph.

    distance: to the nearest camera
    seen_by:  how many photographs saw each
    near:     distance within which nothing is, `Frame.near`
    """
    return (distance < near) | ((distance < CLOSE * near) & (seen_by < WITNESSES))


def confined(gaussians: Gaussians, distance: Float[Tensor, " gaussian"], extent: float) -> Float[Tensor, "gaussian 3"]:
    """Log scales without giants and needles: the largest deviation is at most GIANT times the distance to the nearest
    camera, and at most NEEDLE times the second, unless it is short.

    extent: of the cameras, in scene units
    """
    log_scales = gaussians.log_scales
    second = log_scales.sort(-1).values[:, 1].exp()
    longest = torch.minimum(GIANT * distance, (NEEDLE * second).clamp_min(LONG * extent))
    return torch.minimum(log_scales, longest.clamp_min(1e-12).log()[:, None])
