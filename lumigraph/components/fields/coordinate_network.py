"""The network of NeRF: density from position, colour from position and viewing direction."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from .encodings import FrequencyEncoding
from .layers import Dense, in_chunks

Encoded = Float[Tensor, "sample position"]


class CoordinateNetwork(nn.Module):
    """The network of Mildenhall 2020, figure 7. Density does not depend on direction, so geometry is the same from all.

    position, direction: widths of the encoded inputs
    depth, width: hidden layers before density, and their channels
    skip_layer:   the layer whose activation the input joins again, counted from 1
    exact:        multiply in float32 even where bfloat16 is faster
    Both outputs are raw; activations are the method's.
    """

    def __init__(
        self, position: int, direction: int, depth: int = 8, width: int = 256, skip_layer: int = 5, exact: bool = False
    ):
        super().__init__()

        def layers(inputs: int, count: int) -> nn.Sequential:
            return nn.Sequential(*(Dense(width if i else inputs, width, True, exact) for i in range(count)))

        skip_layer = min(skip_layer, depth - 1)
        self.before = layers(position, skip_layer)
        self.after = layers(width + position, depth - skip_layer)
        self.density_layer = Dense(width, 1, False, exact)
        self.feature = Dense(width, width, False, exact)
        self.colour = nn.Sequential(
            Dense(width + direction, width // 2, True, exact), Dense(width // 2, 3, False, exact)
        )

    def forward(
        self, position: Encoded, direction: Float[Tensor, "sample direction"]
    ) -> tuple[Float[Tensor, " sample"], Float[Tensor, "sample 3"]]:
        """Raw density and colour."""
        density, feature = self.geometry(position)
        return density, self.seen(feature, direction)

    def geometry(self, position: Encoded) -> tuple[Float[Tensor, " sample"], Float[Tensor, "sample width"]]:
        """Raw density, and what the colour layers take of each place."""
        h = self._trunk(position)
        return self.density_layer(h).float()[:, 0], self.feature(h)

    def seen(
        self, feature: Float[Tensor, "sample width"], direction: Float[Tensor, "sample direction"]
    ) -> Float[Tensor, "sample 3"]:
        """Raw colour of places whose features `geometry` gave."""
        return self.colour(torch.cat([feature, direction.to(feature.dtype)], -1)).float()

    def density(self, position: Encoded) -> Float[Tensor, " sample"]:
        """Raw density alone, in two thirds of the time."""
        return self.density_layer(self._trunk(position)).float()[:, 0]

    def _trunk(self, position: Encoded) -> Float[Tensor, "sample width"]:
        position = position.to(self.feature.type_of_products(position))
        return self.after(torch.cat([position, self.before(position)], -1))


class PositionNetwork(nn.Module):
    """Layers of Mildenhall 2020, figure 7, up to the density; outputs are raw.

    octaves:      of the frequency encoding of positions
    depth, width: hidden layers, and their channels
    skip_layer:   the layer whose activation the input joins again, counted from 1
    layer:        class of the layers
    """

    def __init__(self, octaves: int, depth: int, width: int, skip_layer: int, outputs: int, layer: type[Dense] = Dense):
        super().__init__()
        self.encoding = FrequencyEncoding(3, octaves)
        inputs, skip_layer = self.encoding.width, min(skip_layer, depth - 1)

        def layers(first: int, count: int) -> nn.Sequential:
            return nn.Sequential(*(layer(width if i else first, width, True) for i in range(count)))

        self.before, self.after = layers(inputs, skip_layer), layers(width + inputs, depth - skip_layer)
        self.last = layer(width, outputs)

    def forward(self, coordinates: Float[Tensor, "point 3"]) -> Float[Tensor, "point output"]:
        return in_chunks(self._chunk, coordinates)[0]

    def _chunk(self, coordinates: Float[Tensor, "point 3"]) -> tuple[Float[Tensor, "point output"]]:
        encoded = self.encoding(coordinates)
        encoded = encoded.to(self.last.type_of_products(encoded))
        return (self.last(self.after(torch.cat([encoded, self.before(encoded)], -1))).float(),)
