"""Maps: the paper's network of density, and the house's hash table of a truncated signed distance."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from ...components.fields.hash_field import HashField, HashNumbers
from ...components.fields.layers import Dense
from ...components.fields.spaces import Box
from ...method import Field
from ...method.field import Codes, Colours, Densities, Directions, Points

DENSITY_SCALE = 10.0  # factor on the network's output before its softplus: density is large where something is
FIRST_DISTANCE = 0.9  # truncations, the distance that the table begins with everywhere


class MapNetwork(Field):
    """Colour and density of a position from one small network, without a direction (Sucar 2021, section 3.1).

        (c, rho) = F(sin(B x)),   B ~ N(0, deviation^2), learnt

    layers, width: hidden ones; frequencies: rows of B
    All in float32, because poses are tracked by its gradients.
    """

    def __init__(self, layers: int, width: int, frequencies: int, deviation: float):
        super().__init__()
        self.frequencies = nn.Parameter(deviation * torch.randn(frequencies, 3))
        widths = [frequencies, *[width] * layers]
        hidden = [Dense(a, b, relu=True, exact=True) for a, b in zip(widths[:-1], widths[1:], strict=True)]
        self.layers = nn.Sequential(*hidden)
        self.head = Dense(width, 4, exact=True)

    def geometry(self, points: Points, code: Codes | None = None) -> tuple[Densities, Float[Tensor, "point 3"]]:
        out = self.head(self.layers((points @ self.frequencies.t()).sin()))
        return softplus(DENSITY_SCALE * out[:, 3]), out[:, :3]

    def colour(self, features: Any, directions: Directions, code: Codes | None = None) -> Colours:
        return features.sigmoid()


class DistanceTable(HashField):
    """A truncated signed distance s and colour in a hash table (Wang 2023, section 3.1), seen as density.

        rho(x) = sigmoid(-sharpness s(x)) sharpness / truncation    (Or-El 2022, eq. 5; Johari 2023, eq. 3)

    truncation: scene units; s is 1 that far before a surface, -1 that far behind it
    sharpness:  per truncation
    layers:     hidden layers of the colour network
    Light that meets the surface at a right angle is then halved exactly at s = 0.
    """

    def __init__(self, numbers: HashNumbers, width: int, space: Box, truncation: float, sharpness: float, layers: int):
        super().__init__(numbers, width, space, 1.0, layers=layers)
        self.truncation, self.sharpness = truncation, sharpness

    def distance_of(self, features: Float[Tensor, "point geometry"]) -> Float[Tensor, " point"]:
        """Signed distance over the truncation, of a point's features."""
        return features[:, 0] + FIRST_DISTANCE

    def decode(
        self, points: Float[Tensor, "point 3"], encoded: Float[Tensor, "point width"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point geometry"]]:
        geometry = self.density_network(encoded)
        inside = torch.sigmoid(-self.sharpness * self.distance_of(geometry))
        return inside * (self.sharpness / self.truncation), geometry
