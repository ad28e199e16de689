"""Networks of NeRF: density from position, colour from position and viewing direction; and several numbers from a
position alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from .encodings import FrequencyEncoding
from .layers import Dense, in_chunks

Encoded = Float[Tensor, "sample position"]


class SkipNetwork(nn.Module):
    """Hidden layers of Mildenhall 2020, figure 7, up to the density.

    inputs:       width of the encoded position
    depth, width: hidden layers, and their channels
    skip_layer:   the layer whose activation is concatenated with the input, counted from 1
    layer:        makes a layer from its inputs, outputs and whether it has a ReLU
    """

    def __init__(self, inputs: int, depth: int, width: int, skip_layer: int, layer: Callable[[int, int, bool], Dense]):
        super().__init__()

        def layers(first: int, count: int) -> nn.Sequential:
            return nn.Sequential(*(layer(width if i else first, width, True) for i in range(count)))

        skip_layer = min(skip_layer, depth - 1)
        self.before, self.after = layers(inputs, skip_layer), layers(width + inputs, depth - skip_layer)

    def trunk(self, position: Encoded, last: Dense) -> Float[Tensor, "sample width"]:
        """Input of the last layers. last: one of them"""
        position = position.to(last.type_of_products(position))
        return self.after(torch.cat([position, self.before(position)], -1))


class CoordinateNetwork(SkipNetwork):
    """The network of Mildenhall 2020, figure 7. Density does not depend on direction, so geometry is the same from all.

    position, direction: widths of the encoded inputs
    exact: multiply in float32 even where bfloat16 is faster
    head:  channels of the hidden colour layers; one of half the width by default
    Both outputs are raw; activations are the method's.
    """

    def __init__(
        self,
        position: int,
        direction: int,
        depth: int = 8,
        width: int = 256,
        skip_layer: int = 5,
        exact: bool = False,
        head: Sequence[int] = (),
    ):
        dense = partial(Dense, exact=exact)
        super().__init__(position, depth, width, skip_layer, dense)
        self.density_layer, self.feature = dense(width, 1), dense(width, width)
        widths = [width + direction, *(head or [width // 2])]
        self.colour = nn.Sequential(*(dense(a, b, True) for a, b in pairwise(widths)), dense(widths[-1], 3))

    def forward(
        self, position: Encoded, direction: Float[Tensor, "sample direction"]
    ) -> tuple[Float[Tensor, " sample"], Float[Tensor, "sample 3"]]:
        """Raw density and colour."""
        density, feature = self.geometry(position)
        return density, self.seen(feature, direction)

    def geometry(self, position: Encoded) -> tuple[Float[Tensor, " sample"], Float[Tensor, "sample width"]]:
        """Raw density, and input of the colour layers at each position."""
        h = self.trunk(position, self.feature)
        return self.density_layer(h).float()[:, 0], self.feature(h)

    def seen(
        self, feature: Float[Tensor, "sample width"], direction: Float[Tensor, "sample direction"]
    ) -> Float[Tensor, "sample 3"]:
        """Raw colour from features of `geometry`."""
        return self.colour(torch.cat([feature, direction.to(feature.dtype)], -1)).float()

    def density(self, position: Encoded) -> Float[Tensor, " sample"]:
        """Raw density alone, in two thirds of the time."""
        return self.density_layer(self.trunk(position, self.feature)).float()[:, 0]


class PositionNetwork(SkipNetwork):
    """Raw outputs from a position. octaves: of its frequency encoding"""

    def __init__(self, octaves: int, depth: int, width: int, skip_layer: int, outputs: int, layer: type[Dense] = Dense):
        encoding = FrequencyEncoding(3, octaves)
        super().__init__(encoding.width, depth, width, skip_layer, layer)
        self.encoding, self.last = encoding, layer(width, outputs)

    def forward(self, coordinates: Float[Tensor, "point 3"]) -> Float[Tensor, "point output"]:
        return in_chunks(lambda x: (self.last(self.trunk(self.encoding(x), self.last)).float(),), coordinates)[0]
