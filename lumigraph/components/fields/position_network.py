"""The network of NeRF without its layers for the direction: several numbers from a position."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from .dense import Dense, in_chunks
from .encodings import FrequencyEncoding


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
