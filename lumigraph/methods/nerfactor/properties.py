"""Properties of surface points: albedo, a code of the highlight, normals; and light visibility as a network."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ... import kernels
from ...components.fields.encodings import FrequencyEncoding
from ...components.fields.hash_field import OPEN_RESOLUTION, TableNumbers, new_table
from ...components.fields.layers import MLP
from ...components.fields.spaces import Space
from ...components.training.row_optimizers import LazyAdam
from ...exchange.packing import Stored
from ...geometry import unit
from ...method import Part

MAX_TILT = 0.5  # of a normal of the grid, its tangent
PAIRS_PER_CHUNK = 1 << 16


class Raw(NamedTuple):
    """Outputs of networks, before their activations."""

    albedo: Float[Tensor, "point 3"]
    code: Float[Tensor, "point code"]
    normals: Float[Tensor, "point 3"]


class Properties(Part):
    """Albedo, code and normals of surface points."""

    @abstractmethod
    def forward(self, points: Float[Tensor, "point 3"]) -> Raw:
        """Raw outputs."""

    @abstractmethod
    def oriented(self, raw: Float[Tensor, "point 3"], given: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Unit normals by raw outputs and by the geometry's normals."""

    @abstractmethod
    def optimizers_at(self, learning_rate: float, groups: list[dict[str, Any]]) -> list[torch.optim.Optimizer]:
        """Optimizers of these properties and of further groups of parameters."""


class HashProperties(Properties):
    """A hash table and a small network; normals are the geometry's, tilted."""

    def __init__(self, numbers: TableNumbers, hidden_width: int, code: int, space: Space, reach: float):
        super().__init__()
        self.space, self.code = space, code
        self.extent, finer = (1.0, OPEN_RESOLUTION) if space.is_open else (reach, reach)
        self.levels = numbers.levels_of(finer)
        self.table = new_table(self.levels)
        self.network = MLP(numbers.width, hidden_width, 6 + code)

    def forward(self, points: Float[Tensor, "point 3"]) -> Raw:
        encoded = kernels.hash_encode(self.space.warp(points) * (0.5 / self.extent) + 0.5, self.table, self.levels)
        return Raw(*self.network(encoded).split([3, self.code, 3], -1))

    def oriented(self, raw, given):
        return unit(given + MAX_TILT * raw.tanh())

    def optimizers_at(self, learning_rate, groups):
        common: dict[str, Any] = {"lr": learning_rate, "betas": (0.9, 0.99), "eps": 1e-15}
        table = LazyAdam([{"params": [self.table], "name": "properties"}], **common)
        networks = {"params": list(self.network.parameters()), "name": "properties"}
        return [table, torch.optim.Adam([networks, *groups], **common)]

    def storage(self) -> dict[str, Stored]:
        return {"table": Stored("scaled")}


class PropertyNetwork(nn.Module):
    """Layers of ReLU over encoded points, whose input is concatenated again halfway (section 3, the release)."""

    def __init__(self, inputs: int, outputs: int, layers: int, width: int):
        super().__init__()
        self.again = layers // 2
        sizes = [inputs, *[width] * layers]
        self.layers = nn.ModuleList(
            nn.Linear(a + (inputs if k == self.again and k else 0), width) for k, a in enumerate(sizes[:-1])
        )
        self.out = nn.Linear(width, outputs)

    def forward(self, x: Float[Tensor, "point input"]) -> Float[Tensor, "point output"]:
        y = x
        for k, layer in enumerate(self.layers):
            y = layer(torch.cat([y, x], -1) if k == self.again and k else y).relu()
        return self.out(y)


class NetworkProperties(Properties):
    """A network for each property."""

    def __init__(self, frequencies: int, layers: int, width: int, code: int):
        super().__init__()
        self.encoding = FrequencyEncoding(3, frequencies, base=1.0)
        sizes = (3, code, 3)
        self.networks = nn.ModuleList(PropertyNetwork(self.encoding.width, n, layers, width) for n in sizes)

    def forward(self, points: Float[Tensor, "point 3"]) -> Raw:
        encoded = self.encoding(points)
        return Raw(*(network(encoded) for network in self.networks))

    def oriented(self, raw, given):
        return unit(raw)

    def optimizers_at(self, learning_rate, groups):
        own = {"params": list(self.parameters()), "name": "properties"}
        return [torch.optim.Adam([own, *groups], lr=learning_rate)]


class VisibilityNetwork(nn.Module):
    """Share of the light from a direction that reaches a point (section 3.1)."""

    def __init__(self, frequencies: int, direction_frequencies: int, layers: int, width: int):
        super().__init__()
        self.places = FrequencyEncoding(3, frequencies, base=1.0)
        self.ways = FrequencyEncoding(3, direction_frequencies, base=1.0)
        self.network = PropertyNetwork(self.places.width + self.ways.width, 1, layers, width)

    def forward(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "light 3"]
    ) -> Float[Tensor, "point light"]:
        places, ways = self.places(points), self.ways(directions)
        found = [
            self.network(torch.cat([part.repeat_interleave(len(ways), 0), ways.repeat(len(part), 1)], -1))
            for part in places.split(max(1, PAIRS_PER_CHUNK // len(ways)))
        ]
        return torch.cat(found).sigmoid().view(len(points), len(directions))
