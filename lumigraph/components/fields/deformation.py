"""Deformation networks: numbers at a point and a code, with coarse-to-fine octaves (Park 2021)."""

from __future__ import annotations

import math
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from .coordinate_network import SkipNetwork
from .encodings import FrequencyEncoding
from .layers import Dense, in_chunks

FIRST_MOTION = 1e-4  # largest weight of the last layer at first: the scene begins as it is (Park 2021, supplement)


def window(bands: int, alpha: Tensor) -> Float[Tensor, " band"]:
    """Coarse-to-fine weights of an encoding's bands, of which the first alpha are active (Park 2021, eq. 8)."""
    j = torch.arange(bands, device=alpha.device)
    return (1 - torch.cos(math.pi * (alpha - j).clamp(0, 1))) / 2


class DeformationNetwork(SkipNetwork):
    """Numbers at a point and a code: hidden layers over the encoded point and the code, and a last one initialised
    close to zero. All in float32: bfloat16 would quantise motions and poses."""

    def __init__(self, bands: int, code: int, depth: int, width: int, skip_layer: int, outputs: int):
        encoding = FrequencyEncoding(3, bands)
        super().__init__(encoding.width + code, depth, width, skip_layer, partial(Dense, exact=True))
        self.encoding, self.last = encoding, Dense(width, outputs, exact=True)
        nn.init.uniform_(self.last.weight, -FIRST_MOTION, FIRST_MOTION)

    def forward(
        self, points: Float[Tensor, "point 3"], code: Float[Tensor, "point code"], weights: Float[Tensor, " band"]
    ) -> Float[Tensor, "point output"]:
        def answer(points: Tensor, code: Tensor) -> tuple[Tensor]:
            return (self.last(self.trunk(torch.cat([self.encoding(points, weights), code], -1), self.last)),)

        return in_chunks(answer, points, code)[0]

    def differentiable(self, points: Tensor, code: Tensor, weights: Tensor) -> Tensor:
        """The same in plain PyTorch and float32, for second derivatives in points."""
        first = torch.cat([self.encoding(points, weights), code], -1)
        x = self._plain(self.before, first)
        x = self._plain(self.after, torch.cat([first, x], -1))
        return F.linear(x, self.last.weight, self.last.bias)

    @staticmethod
    def _plain(layers: nn.Sequential, x: Tensor) -> Tensor:
        for layer in layers:
            x = F.linear(x, layer.weight, layer.bias).relu()  # type: ignore[arg-type]
        return x
