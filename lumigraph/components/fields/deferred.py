"""Deferred fields: density, diffuse colour and features from position alone; direction comes in once a pixel.

Hedman 2021 (arXiv 2103.14645), section 4.2.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ... import kernels
from ...exchange.baked import ViewNetwork
from ..sampling.spaces import Box, Space
from .activations import truncated_exp
from .dense import Dense, in_chunks
from .encodings import FrequencyEncoding
from .hash_field import WITHIN
from .mlp import MLP

FEATURES = 4
OUTPUTS = 1 + 3 + FEATURES
OCTAVES = 4  # at which the direction is encoded
NOTHING = -100.0  # before the sigmoid
DIM = -4.0  # before the sigmoid: what depends on direction begins as next to nothing


class Deferred(NamedTuple):
    """What is at points: density per unit of the coordinates, diffuse colour and features in [0, 1]."""

    density: Float[Tensor, " sample"]
    diffuse: Float[Tensor, "sample 3"]
    features: Float[Tensor, "sample 4"]

    @staticmethod
    def of(raw: Float[Tensor, "sample 8"]) -> Deferred:
        return Deferred(truncated_exp(raw[:, 0]), torch.sigmoid(raw[:, 1:4]), torch.sigmoid(raw[:, 4:]))


class HashDeferred(nn.Module):
    """All of it by one small network from a multiresolution hash table (Müller 2022)."""

    grows = ("table",)

    def __init__(self, config: Any, space: Space, reach: float):
        super().__init__()
        self.extent, finer = (reach, reach) if isinstance(space, Box) else (1.0, WITHIN)
        self.levels = kernels.HashLevels(
            config.levels,
            config.features_per_level,
            config.log2_hashmap_size,
            config.base_resolution,
            int(config.max_resolution * finer),
        )
        self.table = nn.Parameter(torch.empty(self.levels.offsets[-1], config.features_per_level).uniform_(-1e-4, 1e-4))
        hidden = [config.hidden_width] * config.hidden_layers
        self.layers = MLP(config.levels * config.features_per_level, *hidden, OUTPUTS)

    @property
    def tables(self) -> list[nn.Parameter]:
        """What a step touches a small part of."""
        return [self.table]

    def forward(self, coordinates: Float[Tensor, "sample 3"]) -> Deferred:
        encoded = kernels.hash_encode(coordinates * (0.5 / self.extent) + 0.5, self.table, self.levels)
        return Deferred.of(self.layers(encoded))


class Released(Dense):
    """A layer whose weights may be let go of, and are then of no rows."""

    grows = ("weight", "bias")


class NetworkDeferred(nn.Module):
    """All of it by the paper's network, that of Mildenhall 2020 without its layers for direction."""

    def __init__(self, config: Any):
        super().__init__()
        self.encoding = FrequencyEncoding(3, config.position_frequencies)
        width, inputs = config.hidden_width, self.encoding.width
        skip = min(config.skip_layer, config.hidden_layers - 1)

        def layers(first: int, count: int) -> nn.Sequential:
            return nn.Sequential(*(Released(width if i else first, width, True) for i in range(count)))

        self.before, self.after = layers(inputs, skip), layers(width + inputs, config.hidden_layers - skip)
        self.last = Released(width, OUTPUTS)

    @property
    def tables(self) -> list[nn.Parameter]:
        return []

    def forward(self, coordinates: Float[Tensor, "sample 3"]) -> Deferred:
        (raw,) = in_chunks(self._raw, coordinates)
        return Deferred.of(raw)

    def _raw(self, coordinates: Float[Tensor, "sample 3"]) -> tuple[Float[Tensor, "sample 8"]]:
        encoded = self.encoding(coordinates)
        encoded = encoded.to(self.last.type_of_products(encoded))
        return (self.last(self.after(torch.cat([encoded, self.before(encoded)], -1))).float(),)


class ViewDependence(nn.Module):
    """The tiny network that adds what depends on direction, once a pixel; see `baked.ViewNetwork`."""

    def __init__(self, width: int):
        super().__init__()
        self.first, self.second = nn.Linear(3 * (1 + 2 * OCTAVES) + 3 + FEATURES, width), nn.Linear(width, width)
        self.last = nn.Linear(width, 3)
        nn.init.constant_(self.last.bias, DIM)

    def forward(
        self, directions: Float[Tensor, "ray 3"], diffuse: Float[Tensor, "ray 3"], features: Float[Tensor, "ray 4"]
    ) -> Float[Tensor, "ray 3"]:
        """The colour that is added, in [0, 1]. directions: unit length"""
        h = torch.relu(self.first(torch.cat([encoded(directions), diffuse, features], -1)))
        return torch.sigmoid(self.last(torch.relu(self.second(h))))

    @torch.no_grad()
    def baked(self) -> ViewNetwork:
        """The same for browsers and files."""
        a, b, c = self.first, self.second, self.last
        weights = (a.weight.t(), b.weight.t(), c.weight.t())
        one, two, three = (weight.contiguous().cpu().clone() for weight in weights)
        return ViewNetwork((one, two, three), (a.bias.cpu().clone(), b.bias.cpu().clone(), c.bias.cpu().clone()))

    @torch.no_grad()
    def take(self, network: ViewNetwork | None) -> None:
        """Be a network of the same width, or one that adds nothing."""
        if network is None:
            nn.init.zeros_(self.last.weight)
            nn.init.constant_(self.last.bias, NOTHING)
            return
        layers = self.first, self.second, self.last
        for layer, weight, bias in zip(layers, network.weights, network.biases, strict=True):
            layer.weight.copy_(weight.t())
            layer.bias.copy_(bias)


def encoded(directions: Float[Tensor, "ray 3"]) -> Float[Tensor, "ray 27"]:
    """(d, sin d, sin 2d, sin 4d, sin 8d, cos d, cos 2d, cos 4d, cos 8d), in the order of the published viewer."""
    angles = (directions[:, None] * 2.0 ** torch.arange(OCTAVES, device=directions.device)[:, None]).flatten(1)
    return torch.cat([directions, angles.sin(), angles.cos()], -1)
