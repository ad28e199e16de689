"""Visibility: a small network that knows which places photographs have seen, and from which side (Tancik 2022)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ... import kernels
from ...camera.rays import Rays, Samples
from ...components.fields.encodings import FrequencyEncoding
from ...components.fields.hash_field import side_by_side
from ...components.fields.mlp import MLP
from ...components.sampling.spaces import Space
from ...components.training.regularizers import normalized_distance
from ...components.training.schedules import falling
from ...method import Part

BANDS = 3  # of spherical harmonics: from which side, and no more than that
LEARNING_RATES = 5e-3, 5e-4  # at first and in the end
HORIZON = 0.99  # of normalized_distance distances, where rays that do not end are asked about last


class Visibility(Part):
    """f_v(x, d) in [0, 1]: how much of what is at x a photograph that looks along d sees (Tancik 2022, section 4.2).

    It is learnt from the transmittance of a field along the rays of photographs. The field itself learns nothing of it.

    octaves: of the waves that places are told by
    layers, width: hidden ones
    """

    def __init__(self, space: Space, octaves: int, layers: int, width: int):
        super().__init__()
        self.space, self.encode = space, FrequencyEncoding(3, octaves)
        self.network = MLP(self.encode.width + BANDS**2, *[width] * layers, 1)

    def forward(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> Float[Tensor, " point"]:
        """points: in scene units; directions: unit length, away from the eye"""
        places = self.encode(self.space.warp(points))
        return self.network(side_by_side(places, kernels.spherical_harmonics(directions, BANDS)))[:, 0].sigmoid()

    def error(
        self, rays: Rays, samples: Samples, density: Float[Tensor, " sample"], generator: torch.Generator
    ) -> Float[Tensor, ""]:
        """The mean squared error at one random place of each ray, near ones and far ones alike."""
        with torch.no_grad():
            first, last = (normalized_distance(t).clamp(max=HORIZON) for t in self.space.interval(rays))
            s = torch.lerp(first, last, torch.rand(len(rays), generator=generator).to(first))
            t = s / (1 - s)
            light = transmittance(samples, density, t)
        return (self(rays.at(t).detach(), rays.directions.detach()) - light).square().mean()

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return [torch.optim.Adam([{"params": [*self.parameters()], "name": "visibility"}], LEARNING_RATES[0])]

    def learning_rates(self, step: int, progress: float) -> dict[str, float]:
        return {"visibility": falling(*LEARNING_RATES, progress)}


def transmittance(
    samples: Samples, density: Float[Tensor, " sample"], t: Float[Tensor, " ray"]
) -> Float[Tensor, " ray"]:
    """T = exp(-integral of density from the eye to t): the light that comes back from a distance along each ray."""
    ray = samples.ray_index
    passed = torch.minimum(t[ray] - samples.t_start, samples.length).clamp_min(0)
    return torch.exp(-torch.zeros_like(t).index_add(0, ray, density * passed))
