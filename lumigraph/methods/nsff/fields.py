"""Fields of NSFF: a static one with blending weights, a dynamic one with scene flow, and the two as one field."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad, relu

from ... import kernels
from ...components.fields.coordinate_field import DIRECTION_FREQUENCIES, NetworkNumbers
from ...components.fields.coordinate_network import CoordinateNetwork, SkipNetwork
from ...components.fields.encodings import FrequencyEncoding
from ...components.fields.hash_field import (
    DENSITY_LAYERS,
    GEOMETRY_FEATURES,
    HashField,
    HashNumbers,
    new_table,
    side_by_side,
)
from ...components.fields.layers import MLP, Dense, in_chunks
from ...components.fields.spaces import Space
from ...components.training.row_optimizers import LazyAdam
from ...exchange.packing import Stored
from ...method import Field
from ...method.field import Codes, Colours, Densities, Directions, Points

FIRST_FLOW = 1e-3  # largest weight of the last layer of a motion network at first
MOTION_BANDS, MOTION_SHAPE = 4, (4, 64, 2)  # octaves of the motion network's input; depth, width and skip layer
MOTION_RATE = 0.2  # of the table's learning rate, for that network
TIME_LEVELS = 4  # of each table of space and time
PLANES = (0, 1), (0, 2), (1, 2)  # axes of space beside time in those tables

Motion = Float[Tensor, "point 8"]  # raw: flow to the next moment, to the one before, and the weights of both


class NetworkField(Field):
    """The paper's network of a point, or of a point and a time, with further outputs of its last hidden layer.

    inputs: 3, or 4 with a time
    heads:  number of further outputs: the blending weight of a static field, flow and weights of a dynamic one
    """

    def __init__(self, numbers: NetworkNumbers, hidden_width: int, space: Space, inputs: int, heads: int):
        super().__init__()
        n, self.space, self.timed = numbers, space, inputs > 3
        self.encoding = FrequencyEncoding(inputs, n.position_frequencies)
        self.encode_direction = FrequencyEncoding(3, DIRECTION_FREQUENCIES)
        widths = self.encoding.width, self.encode_direction.width
        self.network = CoordinateNetwork(*widths, n.depth, hidden_width, n.skip_layer, not n.bfloat16)
        self.heads = Dense(hidden_width, heads, exact=True)

    def geometry(self, points: Points, code: Codes | None = None) -> tuple[Densities, Tensor]:
        coordinates = self.space.warp(points)
        if self.timed:
            assert code is not None, "a dynamic field needs a time"
            coordinates = torch.cat([coordinates, 2 * code[:, :1] - 1], 1)

        def answer(x: Tensor) -> tuple[Tensor, Tensor]:
            hidden = self.network.trunk(self.encoding(x), self.network.feature)
            return relu(self.network.density_layer(hidden).float()[:, 0]), hidden

        density, hidden = in_chunks(answer, coordinates)
        return density * self.space.stretch(points), hidden

    def colour(self, features: Tensor, directions: Directions, code: Codes | None = None) -> Colours:
        def answer(hidden: Tensor, directions: Tensor) -> tuple[Tensor]:
            return (self.network.seen(self.network.feature(hidden), self.encode_direction(directions)).sigmoid(),)

        return in_chunks(answer, features, directions)[0]

    def raw_heads(self, features: Tensor, points: Points, code: Codes | None = None) -> Float[Tensor, "point head"]:
        return self.heads(features.float())

    def optimizers_at(self, learning_rate: float) -> list[torch.optim.Optimizer]:
        return [torch.optim.Adam(self.parameters(), learning_rate)]


class StaticHash(HashField):
    """A hash table whose second geometry feature is the blending weight."""

    def raw_heads(self, features: Tensor, points: Points, code: Codes | None = None) -> Float[Tensor, "point 1"]:
        return features[:, 1:2]


class MotionNetwork(SkipNetwork):
    """Raw flows and weights at points and times: a smooth network, unlike a hash table."""

    def __init__(self, bands: int, depth: int, width: int, skip_layer: int):
        encoding = FrequencyEncoding(4, bands)
        super().__init__(encoding.width, depth, width, skip_layer, partial(Dense, exact=True))
        self.encoding, self.last = encoding, Dense(width, 8, exact=True)
        nn.init.uniform_(self.last.weight, -FIRST_FLOW, FIRST_FLOW)

    def forward(self, coordinates: Float[Tensor, "point 4"]) -> Motion:
        return in_chunks(lambda x: (self.last(self.trunk(self.encoding(x), self.last)),), coordinates)[0]


class TimeHash(HashField):
    """A hash table of space beside three of two axes of space and time, so that time is an input of its own.

    moments: cells of time at the finest level
    """

    def __init__(self, numbers: HashNumbers, hidden_width: int, space: Space, reach: float, moments: int):
        super().__init__(numbers, hidden_width, space, reach)
        n = numbers
        coarse = kernels.HashLevels(
            min(TIME_LEVELS, n.levels),
            n.features_per_level,
            n.log2_hashmap_size,
            n.base_resolution,
            max(n.max_resolution // 4, n.base_resolution),
        )
        self.time_levels, self.time_scale = coarse, min(1.0, moments / coarse.finest)
        self.time_tables = nn.ParameterList(new_table(coarse) for _ in PLANES)
        width = n.width + len(PLANES) * coarse.levels * coarse.features
        self.density_network = MLP(width, *[hidden_width] * DENSITY_LAYERS, GEOMETRY_FEATURES)
        self.motion = MotionNetwork(MOTION_BANDS, *MOTION_SHAPE)

    def geometry(self, points: Points, code: Codes | None = None) -> tuple[Densities, Tensor]:
        assert code is not None, "a dynamic field needs a time"
        place, time = self.space.warp(points) * (0.5 / self.extent) + 0.5, code[:, :1] * self.time_scale
        planes = [
            kernels.hash_encode(torch.cat([place[:, axes], time], 1), table, self.time_levels)
            for axes, table in zip(PLANES, self.time_tables, strict=True)
        ]
        return self.decode(points, side_by_side(self.encode(points), *planes))

    def raw_heads(self, features: Tensor, points: Points, code: Codes | None = None) -> Motion:
        assert code is not None
        return self.motion(torch.cat([self.space.warp(points), 2 * code[:, :1] - 1], 1))

    def optimizers_at(
        self, learning_rate: float, weight_decay: float = 0.0, scale: float | None = None, groups: Any = ()
    ) -> list[torch.optim.Optimizer]:
        motion = {"params": list(self.motion.parameters()), "scale": MOTION_RATE}
        tables = LazyAdam(list(self.time_tables), lr=learning_rate, betas=(0.9, 0.99), eps=1e-15)
        return [*super().optimizers_at(learning_rate, weight_decay, scale, [motion, *groups]), tables]

    def storage(self) -> dict[str, Stored]:
        planes = {f"time_tables.{i}": Stored("scaled") for i in range(len(PLANES))}
        return super().storage() | planes


class BlendedField(Field):
    """Static and dynamic field as one (Li 2021, eqs. 9 and 10):

        sigma = v sigma_static + (1 - v) sigma_dynamic       sigma c = v sigma_static c_static + (1 - v) ...

    The code of a point is its time, from 0 to 1, and a number that is added to v: 1 shows the static field alone, -1
    the dynamic one. features: of both fields, the static one's share of density, and the dynamic density.
    """

    deforms = True

    def __init__(self, static: NetworkField | StaticHash | None, dynamic: NetworkField | TimeHash):
        super().__init__()
        self.static, self.dynamic = static, dynamic

    def geometry(self, points: Points, code: Codes | None = None) -> tuple[Densities, Any]:
        moving, features = self.dynamic.geometry(points, code)
        if self.static is None:
            return moving, (features, features[:, :0], pad(moving[:, None], (1, 0)))
        assert code is not None
        still, static_features = self.static.geometry(points)
        v = (self.static.raw_heads(static_features, points)[:, 0].sigmoid() + code[:, 1]).clamp(0, 1)
        density = v * still + (1 - v) * moving
        share = v * still / density.clamp_min(1e-12)
        return density, (features, static_features, torch.stack([share, moving], 1))

    def colour(self, features: Any, directions: Directions, code: Codes | None = None) -> Colours:
        return self.colours(features, directions)[0]

    def colours(self, features: Any, directions: Directions) -> tuple[Colours, Colours]:
        """Colours of the blended field, and of the dynamic one alone."""
        of_dynamic, of_static, numbers = features
        moving = self.dynamic.colour(of_dynamic, directions)
        if self.static is None:
            return moving, moving
        return torch.lerp(moving, self.static.colour(of_static, directions), numbers[:, :1]), moving
