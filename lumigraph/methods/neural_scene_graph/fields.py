"""Fields of a class: density and colour in a box's coordinates, under the latent code of an instance (Ost 2021, 3.2).

A code of these fields is the latent code followed by numbers of the box's pose, which colour alone depends on.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from ...components.fields.coordinate_field import LatentField, NetworkNumbers
from ...components.fields.encodings import FrequencyEncoding
from ...components.fields.hash_field import DENSITY_LAYERS, GEOMETRY_FEATURES, HashField, HashNumbers, side_by_side
from ...components.fields.layers import MLP, truncated_exp
from ...components.fields.spaces import Box, Space
from ...method.field import Codes, Colours, Densities, Directions, Points

CUBE = Box(((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), 0.0)  # coordinates of a box
POSE_NUMBERS = 4  # that colour depends on: the box's location or heading, and the side of a symmetric box
MAX_BANDS = 2  # spherical-harmonics bands of a hash field: few views show each side of an instance
POSE_FREQUENCIES = 4  # octaves of these: multires_obj of the release
THIN = 2.0  # density of a hash field is exp(-THIN) per coordinate at first, so that nothing hides the background


def late_softplus(raw: Tensor) -> Tensor:
    """Density of a network's output, thin at first."""
    return softplus(raw - THIN)


class NetworkClassField(LatentField):
    """The paper's networks: one of position and latent code, then one of direction and pose (eq. 5)."""

    def __init__(self, numbers: NetworkNumbers, hidden_width: int, space: Space, latent: int):
        pose = FrequencyEncoding(POSE_NUMBERS - 1, POSE_FREQUENCIES)
        named: dict[str, Any] = {"code": pose.width + 1, "latent": latent, "keep_input": True}
        super().__init__(numbers, hidden_width, space, activation=late_softplus, **named)
        self.encode_pose = pose

    def colour(self, features: Any, directions: Directions, code: Codes | None = None) -> Colours:
        assert code is not None
        latent, place, side = code.split([self.latent, POSE_NUMBERS - 1, 1], -1)
        return super().colour(features, directions, torch.cat([latent, self.encode_pose(place), side], -1))


class HashClassField(HashField):
    """A hash table over the box and two small networks. The latent code scales the table's features and is an input of
    the first network, so that instances share common features and differ in detail. The second one has no code, so that
    instances share their lighting."""

    deforms = True

    def __init__(self, numbers: HashNumbers, hidden_width: int, space: Space, reach: float, latent: int):
        numbers = replace(numbers, sh_bands=min(numbers.sh_bands, MAX_BANDS))
        super().__init__(numbers, hidden_width, space, reach, code=POSE_NUMBERS)
        self.latent = latent
        self.modulation = nn.Linear(latent, numbers.width, bias=False)
        widths = [hidden_width] * DENSITY_LAYERS
        self.density_network = MLP(numbers.width + latent, *widths, GEOMETRY_FEATURES)

    def geometry(self, points: Points, code: Codes | None = None) -> tuple[Densities, Float[Tensor, "point geometry"]]:
        assert code is not None
        latent = code[:, : self.latent]
        scaled = self.encode(points) * (1 + self.modulation(latent))
        geometry = self.density_network(side_by_side(scaled, latent))
        return truncated_exp(geometry[:, 0] - THIN), geometry

    def colour(self, features: Tensor, directions: Directions, code: Codes | None = None) -> Colours:
        assert code is not None
        return super().colour(features, directions, code[:, self.latent :])

    def optimizers_at(self, learning_rate: float, groups: Any = ()) -> list[torch.optim.Optimizer]:  # type: ignore[override]
        """Adam for table and networks. groups: further groups of parameters"""
        return super().optimizers_at(learning_rate, groups=[{"params": list(self.modulation.parameters())}, *groups])


ClassField = NetworkClassField | HashClassField
