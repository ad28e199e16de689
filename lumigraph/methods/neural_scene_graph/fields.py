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

from ...components.fields.coordinate_field import NetworkNumbers
from ...components.fields.coordinate_network import CoordinateNetwork
from ...components.fields.encodings import FrequencyEncoding
from ...components.fields.hash_field import HashField, HashNumbers, side_by_side
from ...components.fields.layers import MLP, in_chunks, truncated_exp
from ...components.sampling.spaces import Box
from ...method import Field
from ...method.field import Codes, Colours, Densities, Directions, Points

CUBE = Box(((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), 0.0)  # coordinates of a box
POSE_NUMBERS = 4  # that colour depends on: the box's location or heading, and the side of a symmetric box
MAX_BANDS = 2  # spherical-harmonics bands of a hash field: few views show each side of an instance
POSE_FREQUENCIES = 4  # octaves of these: multires_obj of the release
THIN = 2.0  # density of a hash field is exp(-THIN) per coordinate at first, so that nothing hides the background


class NetworkClassField(Field):
    """The paper's networks: one of position and latent code, then one of direction and pose (eq. 5)."""

    deforms = True

    def __init__(self, numbers: NetworkNumbers, hidden_width: int, latent: int):
        super().__init__()
        self.latent = latent
        self.encode_position = FrequencyEncoding(3, numbers.position_frequencies)
        self.encode_direction = FrequencyEncoding(3, numbers.direction_frequencies)
        self.encode_pose = FrequencyEncoding(POSE_NUMBERS - 1, POSE_FREQUENCIES)
        inputs = self.encode_position.width + latent, self.encode_direction.width + self.encode_pose.width + 1
        shape = numbers.depth, hidden_width, numbers.skip_layer
        self.network = CoordinateNetwork(*inputs, *shape, exact=not numbers.bfloat16)

    def geometry(self, points: Points, code: Codes | None = None) -> tuple[Densities, Tensor]:
        assert code is not None

        def answer(points: Tensor, latent: Tensor) -> tuple[Tensor, Tensor]:
            raw, feature = self.network.geometry(torch.cat([self.encode_position(points), latent], -1))
            return softplus(raw - THIN), feature

        return in_chunks(answer, points, code[:, : self.latent])  # type: ignore[return-value]

    def colour(self, features: Tensor, directions: Directions, code: Codes | None = None) -> Colours:
        assert code is not None

        def answer(feature: Tensor, directions: Tensor, pose: Tensor) -> tuple[Tensor]:
            place, side = pose.split([POSE_NUMBERS - 1, 1], -1)
            seen = torch.cat([self.encode_direction(directions), self.encode_pose(place), side], -1)
            return (self.network.seen(feature, seen).sigmoid(),)

        return in_chunks(answer, features, directions, code[:, self.latent :])[0]

    def optimizers_at(self, learning_rate: float, groups: Any = ()) -> list[torch.optim.Optimizer]:
        """Adam for the networks. groups: further groups of parameters"""
        return [torch.optim.Adam([{"params": list(self.network.parameters())}, *groups], learning_rate, eps=1e-7)]


class HashClassField(HashField):
    """A hash table over the box and two small networks. The latent code scales the table's features and is an input of
    the first network, so that instances share common features and differ in detail. The second one has no code, so that
    instances share their lighting."""

    deforms = True

    def __init__(self, numbers: HashNumbers, hidden_width: int, latent: int):
        numbers = replace(numbers, sh_bands=min(numbers.sh_bands, MAX_BANDS))
        super().__init__(numbers, hidden_width, CUBE, 1.0, code=POSE_NUMBERS)
        self.latent = latent
        self.modulation = nn.Linear(latent, numbers.width, bias=False)
        widths = [hidden_width] * numbers.density_layers
        self.density_network = MLP(numbers.width + latent, *widths, numbers.geometry_features)

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
