"""Networks of GANcraft: style, the field at blocks, sky, and the neural renderer; all depend on a style code."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import interpolate, leaky_relu, normalize, softplus

from ... import kernels
from ...components.fields.encodings import FrequencyEncoding

SLOPE = 0.2  # of leaky rectifiers
BORDER = 4  # pixels by which the neural renderer sees beyond each pixel: four convolutions of 3x3
MIN_ENCODER_SIDE = 4  # pixels across, at which the style encoder ends
MAX_LOG_VARIANCE, FIRST_LOG_VARIANCE = 4.0, -3.0  # of style codes, either way, and before anything is learnt
FIRST_DENSITY = 4.0  # of all blocks, per block, before anything is learnt

Style = Float[Tensor, "1 style"]
Pictures = Float[Tensor, "picture _ _ _"]


def rectified(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    return leaky_relu(x, SLOPE)


class StyleEncoder(nn.Module):
    """Mean and logarithm of the variance of the style code of a picture: strided convolutions (Park 2019, figure 14).

    size: pixels to which pictures are resized
    """

    def __init__(self, size: int, width: int, code: int):
        super().__init__()
        self.size = size
        widths = [3, *(min(width << k, 8 * width) for k in range(int(math.log2(size // MIN_ENCODER_SIDE))))]
        layers = [nn.Conv2d(a, b, 3, 2, 1) for a, b in pairwise(widths)]
        for layer in layers:  # so that codes of pictures are not all noise at first, and then never used
            nn.init.kaiming_normal_(layer.weight, SLOPE)
        self.layers = nn.ModuleList(layers)
        self.out = nn.Linear(widths[-1] * MIN_ENCODER_SIDE**2, 2 * code)
        nn.init.constant_(self.out.bias[code:], FIRST_LOG_VARIANCE)

    def forward(self, pictures: Pictures) -> tuple[Float[Tensor, "picture code"], Float[Tensor, "picture code"]]:
        """pictures: in [-1, 1]"""
        x = interpolate(pictures, size=(self.size, self.size), mode="bilinear", antialias=True)
        for layer in self.layers:
            x = rectified(layer(x))
        mean, log_variance = self.out(x.flatten(1)).chunk(2, -1)
        return mean, MAX_LOG_VARIANCE * (log_variance / MAX_LOG_VARIANCE).tanh()


def drawn(mean: Tensor, log_variance: Tensor, generator: torch.Generator) -> Float[Tensor, "picture code"]:
    """Codes of the encoder's distribution (Kingma 2014): mean + deviation times a standard normal number."""
    return mean + (0.5 * log_variance).exp() * torch.randn(mean.shape, generator=generator).to(mean.device)


def divergence(mean: Tensor, log_variance: Tensor) -> Tensor:
    """KL divergence of the encoder's distribution from the standard normal one, on average over numbers of a code."""
    return 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).mean()


class StyleNetwork(nn.Module):
    """Style of the networks below from a code, which is normalised (supplement of Hao 2021, section A)."""

    def __init__(self, code: int, width: int, layers: int):
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise([code, *[width] * (layers + 1)]))

    def forward(self, code: Float[Tensor, "1 code"]) -> Style:
        x = normalize(code, dim=-1)
        for layer in self.layers:
            x = rectified(layer(x))
        return x


class Modulated(nn.Module):
    """y = (1 + a) W x + b, with a and b affine in the style."""

    def __init__(self, inputs: int, outputs: int, style: int):
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.modulation = nn.Linear(style, 2 * outputs)

    def forward(self, x: Float[Tensor, "sample input"], style: Style) -> Float[Tensor, "sample output"]:
        scale, shift = self.modulation(style).chunk(2, -1)
        return torch.addcmul(shift, self.linear(x), 1 + scale)


class BlockField(nn.Module):
    """Density and features within blocks, from learnt features at their corners (section 3.2).

    F(p, l, z): features of the eight corners, blended trilinearly, partly encoded as waves; label l of the block; style
    z.

    values: a row of features for each corner of a block; corners that several blocks share count once
    """

    grows: ClassVar[tuple[str, ...]] = ("values",)

    def __init__(self, features: int, encoded: int, bands: int, labels: int, width: int, style: int, outputs: int):
        super().__init__()
        self.encoded = encoded
        self.encoding = FrequencyEncoding(encoded, bands, keep_input=False)
        self.values = nn.Parameter(torch.zeros(0, features))
        self.first = nn.Linear(self.encoding.width + features - encoded, width)
        self.label = nn.Embedding(labels, width)
        self.trunk = nn.ModuleList(Modulated(width, width, style) for _ in range(3))
        self.density = nn.Linear(width, 1)
        self.colour = nn.ModuleList(Modulated(width, width, style) for _ in range(2))
        self.out = nn.Linear(width, outputs)

    def forward(
        self, places: Float[Tensor, "sample 3"], nodes: kernels.Nodes, label: Int[Tensor, " sample"], style: Style
    ) -> tuple[Float[Tensor, " sample"], Float[Tensor, "sample feature"]]:
        """Density per block, and features in [-1, 1].

        places: in the unit cube of `nodes`, the corners of blocks
        """
        corner = kernels.sparse_grid(places, nodes, self.values)
        waves = self.encoding(corner[:, : self.encoded].contiguous())
        x = rectified(self.first(torch.cat([waves, corner[:, self.encoded :]], -1)) + self.label(label))
        for layer in self.trunk:
            x = rectified(layer(x, style))
        density = softplus(self.density(x)[:, 0] + math.log(math.expm1(FIRST_DENSITY)))
        for layer in self.colour:
            x = rectified(layer(x, style))
        return density, self.out(x).clamp(-1, 1)


class SkyNetwork(nn.Module):
    """Features of the sky in a direction, in [-1, 1] (section 3.2)."""

    def __init__(self, bands: int, layers: int, width: int, style: int, outputs: int):
        super().__init__()
        self.encoding = FrequencyEncoding(3, bands)
        self.style = nn.Linear(style, width, bias=False)
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise([self.encoding.width, *[width] * layers]))
        self.out = nn.Linear(width, outputs)

    def forward(self, directions: Float[Tensor, "ray 3"], style: Style) -> Float[Tensor, "ray feature"]:
        x = rectified(self.layers[0](self.encoding(directions)) + self.style(style))
        for layer in self.layers[1:]:
            x = rectified(layer(x))
        return self.out(x).clamp(-1, 1)


class NeuralRenderer(nn.Module):
    """Colours in [-1, 1] from a picture of features: convolutions that see 9x9 pixels (section 3.2, supplement A)."""

    def __init__(self, features: int, width: int, style: int):
        super().__init__()
        self.modulation = nn.Linear(style, 4 * width)
        self.first = nn.Conv2d(features, width, 1)
        self.one, self.other = (
            nn.ModuleList(nn.Conv2d(width, width, kernel, 1, kernel // 2) for kernel in (3, 3, 1)) for _ in range(2)
        )
        self.out = nn.Conv2d(width, 3, 1)

    def forward(self, features: Pictures, style: Style) -> Pictures:
        scale_a, shift_a, scale_b, shift_b = self.modulation(style)[..., None, None].chunk(4, 1)
        x = rectified(self.first(features))
        modulations = ((scale_a, shift_a), (scale_b, shift_b), None)
        for one, other, modulation in zip(self.one, self.other, modulations, strict=True):
            x = x + other(rectified(one(x)))
            x = rectified(x if modulation is None else x * (1 + modulation[0]) + modulation[1])
        return self.out(x).tanh()
