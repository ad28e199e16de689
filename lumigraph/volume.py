"""Volume rendering: one weight per sample gives colour, depth, opacity and anything else."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from . import kernels
from .rays import Rendering, Samples


def composite(
    samples: Samples,
    density: Float[Tensor, " sample"],
    rgb: Float[Tensor, "sample 3"],
    background: Float[Tensor, "#ray 3"] | None = None,
    stop: float = 0.0,
    **values: Float[Tensor, "sample _"],
) -> Rendering:
    """Colour, expected distance and opacity of each ray (Max 1995, eq. 9; Mildenhall 2020, eq. 3).

    density:    per scene unit
    background: what lies behind the last sample; black if None
    stop:       transmittance below which a ray ends
    values:     further quantities to accumulate with the same weights, by name, into the rendering's extras
    """
    columns = torch.cat([rgb, samples.t[:, None], *values.values()], -1)
    total, opacity, weights = kernels.composite(density * samples.length, columns, samples.ray_starts, stop)
    colour, distance, *rest = total.split([3, 1, *(v.shape[-1] for v in values.values())], -1)
    if background is not None:
        colour = colour + (1 - opacity)[:, None] * background
    hit = opacity > 1e-3
    depth = torch.where(hit, distance[:, 0] / opacity.clamp_min(1e-3), torch.inf)
    return Rendering(colour, depth, opacity, dict(zip(values, rest, strict=True)))
