"""Volume rendering: weights of samples along rays, colour, depth and opacity."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from . import kernels
from .camera.rays import Rendering, Samples
from .color.blending import over


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
        colour = over(colour, opacity, background)
    hit = opacity > 1e-3
    depth = torch.where(hit, distance[:, 0] / opacity.clamp_min(1e-3), torch.inf)
    return Rendering(colour, depth, opacity, dict(zip(values, rest, strict=True)))


def weights_of(samples: Samples, density: Float[Tensor, " sample"], stop: float = 0.0) -> Float[Tensor, " sample"]:
    """Weights of samples, T_i (1 - exp(-sigma_i delta_i)); see `composite`."""
    tau = density * samples.length
    return kernels.composite(tau, tau[:, None], samples.ray_starts, stop)[2]


FIRST_STRETCH = 8  # samples per ray in the first query; each further query has twice as many


@torch.no_grad()
def visible_weights(
    samples: Samples, thickness_of: Callable[[Int[Tensor, " asked"]], Float[Tensor, " asked"]], stop: float
) -> Float[Tensor, " sample"]:
    """Weights of samples, 0 beyond termination, with few queries: front to back, a part of each ray at a time.

    thickness_of: optical thickness of the samples of these numbers
    stop:         transmittance below which a ray terminates, as in `composite`
    """
    begin, end = samples.ray_starts[:-1], samples.ray_starts[1:]
    light, tau = torch.ones(len(begin), device=begin.device), torch.zeros_like(samples.t_start)
    stretch = FIRST_STRETCH
    while len(going := ((begin < end) & (light >= stop)).nonzero()[:, 0]):
        begin, end, light = begin[going], end[going], light[going]
        starts = packed((end - begin).clamp(max=stretch))
        asked = torch.arange(int(starts[-1]), device=begin.device)
        asked += torch.repeat_interleave(begin - starts[:-1], starts.diff(), output_size=len(asked))
        thickness = thickness_of(asked)
        tau[asked] = thickness
        light = light * (1 - kernels.composite(thickness, thickness[:, None], starts)[1])
        begin, stretch = begin + stretch, 2 * stretch
    return kernels.composite(tau, tau[:, None], samples.ray_starts, stop)[2]


def packed(counts: Int[Tensor, " ray"]) -> Int[Tensor, " ray_plus_one"]:
    """Start offset of each ray's samples in a packed list."""
    return torch.nn.functional.pad(counts.cumsum(0), (1, 0))
