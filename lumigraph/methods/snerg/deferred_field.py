"""Deferred fields: density, diffuse colour and features from position alone; direction comes in once a pixel.

Hedman 2021 (arXiv 2103.14645), section 4.2.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ... import kernels
from ...components.fields.coordinate_network import PositionNetwork
from ...components.fields.hash_field import OPEN_RESOLUTION, TableNumbers, new_table
from ...components.fields.layers import MLP, Dense, truncated_exp
from ...components.fields.spaces import Space
from ...exchange.baked import ViewNetwork
from ...method import Field
from ...method.field import Colours, Densities, Directions, Points

FEATURES = 4
OUTPUTS = 1 + 3 + FEATURES
OCTAVES = 4  # of the encoded direction
NOTHING = -100.0  # before the sigmoid
DIM = -4.0  # before the sigmoid: the view-dependent colour begins close to zero

Deferred = tuple[Float[Tensor, "point 3"], Float[Tensor, "point 4"]]  # diffuse colour and features in [0, 1]
Geometry = Callable[[Float[Tensor, "point 3"]], tuple[Float[Tensor, " point"], Deferred]]  # density per scene unit


class DeferredField(Field):
    """Density, diffuse colour and features at points; `colour` is the diffuse one."""

    def __init__(self, space: Space):
        super().__init__()
        self.space = space

    @property
    def tables(self) -> list[nn.Parameter]:
        """Parameters of which a step updates few rows."""
        return []

    @abstractmethod
    def raw(self, coordinates: Float[Tensor, "point 3"]) -> Float[Tensor, "point 8"]:
        """Outputs before their activations, at coordinates of the space."""

    def geometry(self, points: Points, code: Tensor | None = None) -> tuple[Densities, Deferred]:
        raw = self.raw(self.space.warp(points))
        density = truncated_exp(raw[:, 0]) * self.space.stretch(points)
        return density, (torch.sigmoid(raw[:, 1:4]), torch.sigmoid(raw[:, 4:]))

    def colour(self, features: Deferred, directions: Directions, code: Tensor | None = None) -> Colours:
        return features[0]


class HashDeferred(DeferredField):
    """One small network behind a multiresolution hash table (Müller 2022).

    reach: half-size of the cube that a bounded scene lies in
    """

    grows = ("table",)

    def __init__(self, numbers: TableNumbers, layers: int, width: int, space: Space, reach: float):
        super().__init__(space)
        self.extent, finer = (1.0, OPEN_RESOLUTION) if space.is_open else (reach, reach)
        self.levels = numbers.levels_of(finer)
        self.table = new_table(self.levels)
        self.layers = MLP(numbers.width, *[width] * layers, OUTPUTS)

    @property
    def tables(self) -> list[nn.Parameter]:
        return [self.table]

    def raw(self, coordinates: Float[Tensor, "point 3"]) -> Float[Tensor, "point 8"]:
        return self.layers(kernels.hash_encode(coordinates * (0.5 / self.extent) + 0.5, self.table, self.levels))


class Released(Dense):
    """A layer with releasable weights, which then have no rows."""

    grows = ("weight", "bias")


class NetworkDeferred(DeferredField):
    """The paper's network."""

    def __init__(self, octaves: int, layers: int, width: int, skip_layer: int, space: Space):
        super().__init__(space)
        self.layers = PositionNetwork(octaves, layers, width, skip_layer, OUTPUTS, Released)

    def raw(self, coordinates: Float[Tensor, "point 3"]) -> Float[Tensor, "point 8"]:
        return self.layers(coordinates)


class ViewDependence(nn.Module):
    """Network of the view-dependent colour, evaluated once a pixel; see `baked.ViewNetwork`."""

    def __init__(self, width: int):
        super().__init__()
        self.first, self.second = nn.Linear(3 * (1 + 2 * OCTAVES) + 3 + FEATURES, width), nn.Linear(width, width)
        self.last = nn.Linear(width, 3)
        nn.init.constant_(self.last.bias, DIM)

    def forward(
        self, directions: Float[Tensor, "ray 3"], diffuse: Float[Tensor, "ray 3"], features: Float[Tensor, "ray 4"]
    ) -> Float[Tensor, "ray 3"]:
        """View-dependent colour, in [0, 1]. directions: unit length"""
        h = torch.relu(self.first(torch.cat([encoded(directions), diffuse, features], -1)))
        return torch.sigmoid(self.last(torch.relu(self.second(h))))

    @torch.no_grad()
    def baked(self) -> ViewNetwork:
        """The network for browsers and files."""
        a, b, c = self.first, self.second, self.last
        weights = (a.weight.t(), b.weight.t(), c.weight.t())
        one, two, three = (weight.contiguous().cpu().clone() for weight in weights)
        return ViewNetwork((one, two, three), (a.bias.cpu().clone(), b.bias.cpu().clone(), c.bias.cpu().clone()))

    @torch.no_grad()
    def take(self, network: ViewNetwork | None) -> None:
        """Load a network of the same width, or one without contribution."""
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
