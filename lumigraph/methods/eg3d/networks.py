"""Networks of EG3D: StyleGAN2's synthesis (Karras et al. 2020, arXiv 1912.04958), super-resolution, decoder."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import conv2d, conv_transpose2d, interpolate, softplus

from ...components.training.adversarial import EPSILON, MIN_PICTURE_SIDE, EqualisedLinear, doubled, rectified

Style = Float[Tensor, "picture style"]
Styles = Float[Tensor, "picture layer style"]
Pictures = Float[Tensor, "picture _ _ _"]


class ModulatedConvolution(nn.Module):
    """Convolution with input channels scaled by a style, and outputs normalised to unit variance (Karras 2020, eqs. 1
    and 3).

    up:           twice the size, as a transposed convolution and the filter 1 3 3 1
    demodulated:  divide outputs by their expected deviation
    """

    def __init__(self, inputs: int, outputs: int, style: int, kernel: int = 3, up: bool = False, demodulated=True):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs, kernel, kernel))
        self.style = EqualisedLinear(style, inputs, bias=1.0)
        self.scale, self.up, self.demodulated = 1 / (inputs * kernel**2) ** 0.5, up, demodulated

    def forward(self, x: Pictures, style: Style) -> Pictures:
        s, weight = self.style(style), self.scale * self.weight
        x = x * s[:, :, None, None]
        if self.up:
            x = conv_transpose2d(x, weight.transpose(0, 1), stride=2)
            line = x.new_tensor([1.0, 3.0, 3.0, 1.0]) / 4
            x = conv2d(x, (line[:, None] * line).expand(x.shape[1], 1, 4, 4), padding=1, groups=x.shape[1])
        else:
            x = conv2d(x, weight, padding=weight.shape[-1] // 2)
        if self.demodulated:
            expected = s.square() @ weight.square().sum((2, 3)).T
            x = x * (expected + EPSILON).rsqrt()[:, :, None, None]
        return x


class SynthesisLayer(nn.Module):
    """A modulated convolution, noise of a learnt strength, bias and rectifier (Karras 2020, figure 2c).

    size: pixels across of the output, for noise; 0 for none
    """

    noise: Tensor

    def __init__(self, inputs: int, outputs: int, style: int, size: int = 0, up: bool = False):
        super().__init__()
        self.convolution = ModulatedConvolution(inputs, outputs, style, up=up)
        self.bias = nn.Parameter(torch.zeros(outputs))
        self.strength = nn.Parameter(torch.zeros(())) if size else None
        if size:
            self.register_buffer("noise", torch.randn(size, size))  # of renderings

    def forward(self, x: Pictures, style: Style, generator: torch.Generator | None = None) -> Pictures:
        """generator: of fresh noise, in training; None takes the same noise each time"""
        x = self.convolution(x, style)
        if self.strength is not None:
            noise = self.noise
            if generator is not None:
                noise = torch.randn(len(x), 1, *x.shape[2:], generator=generator).to(x)
            x = x + self.strength * noise
        return rectified(x + self.bias[:, None, None])


class ToPicture(nn.Module):
    """Channels of a picture from features, by a modulated 1x1 convolution."""

    def __init__(self, inputs: int, channels: int, style: int):
        super().__init__()
        self.convolution = ModulatedConvolution(inputs, channels, style, kernel=1, demodulated=False)
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Pictures, style: Style) -> Pictures:
        return self.convolution(x, style) + self.bias[:, None, None]


class SynthesisNetwork(nn.Module):
    """StyleGAN2's synthesis network: a learnt constant of 4x4, blocks of twice the size each, pictures added up
    (Karras 2020, figure 7b). Layer i takes style i; a block's picture takes that of the layer after it.

    widths: channels at each size, the largest first and 4x4 last
    """

    def __init__(self, channels: int, widths: Sequence[int], style: int):
        super().__init__()
        smallest, *_ = rising = list(reversed(widths))
        self.constant = nn.Parameter(torch.randn(smallest, MIN_PICTURE_SIDE, MIN_PICTURE_SIDE))
        layers, pictures = (
            [SynthesisLayer(smallest, smallest, style, MIN_PICTURE_SIDE)],
            [ToPicture(smallest, channels, style)],
        )
        for octave, (a, b) in enumerate(pairwise(rising), start=1):
            size = MIN_PICTURE_SIDE << octave
            layers += [SynthesisLayer(a, b, style, size, up=True), SynthesisLayer(b, b, style, size)]
            pictures.append(ToPicture(b, channels, style))
        self.layers, self.pictures = nn.ModuleList(layers), nn.ModuleList(pictures)

    @property
    def styles(self) -> int:
        """Number of styles."""
        return len(self.layers) + 1

    def forward(self, styles: Styles, generator: torch.Generator | None = None) -> Pictures:
        first, *others = self.layers
        x = first(self.constant.expand(len(styles), -1, -1, -1), styles[:, 0], generator)
        picture = self.pictures[0](x, styles[:, 1])
        for block, to_picture in enumerate(list(self.pictures)[1:]):
            at = 2 * block
            x = others[at](x, styles[:, at + 1], generator)
            x = others[at + 1](x, styles[:, at + 2], generator)
            picture = doubled(picture) + to_picture(x, styles[:, at + 3])
        return picture


class SuperResolution(nn.Module):
    """Two blocks that turn features into a picture of 2 or 4 times the size (Chan 2022, section 4.3). Every layer takes
    the last style, and there is no noise.

    widths: channels of both blocks
    factor: 2, by the second block alone, or 4
    """

    def __init__(self, features: int, widths: tuple[int, int], style: int, factor: int):
        super().__init__()
        self.up = (factor == 4, True)
        pairs = list(pairwise((features, *widths)))
        self.layers = nn.ModuleList(
            layer
            for (a, b), up in zip(pairs, self.up, strict=True)
            for layer in (SynthesisLayer(a, b, style, up=up), SynthesisLayer(b, b, style))
        )
        self.pictures = nn.ModuleList(ToPicture(b, 3, style) for _, b in pairs)

    def forward(self, features: Pictures, style: Style) -> Pictures:
        """features: in [0, 1], of which the first three are colours"""
        x, picture = 2 * features - 1, 2 * features[:, :3] - 1
        for block, up in enumerate(self.up):
            x = self.layers[2 * block + 1](self.layers[2 * block](x, style), style)
            picture = (doubled(picture) if up else picture) + self.pictures[block](x, style)
        return 0.5 + 0.5 * picture


class PlaneDecoder(nn.Module):
    """Density before its activation, and features in [0, 1], from a point's plane features (section 4.1)."""

    def __init__(self, inputs: int, width: int, features: int):
        super().__init__()
        self.first, self.second = EqualisedLinear(inputs, width), EqualisedLinear(width, 1 + features)

    def forward(
        self, x: Float[Tensor, "point input"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point feature"]]:
        y = self.second(softplus(self.first(x)))
        return y[:, 0], clamped(y[:, 1:])


def clamped(x: Float[Tensor, "point feature"]) -> Float[Tensor, "point feature"]:
    """Sigmoid a little beyond [0, 1], as mip-NeRF has it (Barron 2021), so that white and black are within reach."""
    return x.sigmoid() * 1.002 - 0.001


def resized(pictures: Pictures, size: tuple[int, int]) -> Pictures:
    """Pictures of another size (height, width), filtered where that is smaller."""
    if tuple(pictures.shape[-2:]) == size:
        return pictures
    return interpolate(pictures, size=size, mode="bilinear", align_corners=False, antialias=True)


def blurred(pictures: Pictures, deviation: float) -> Pictures:
    """Pictures under the filter 2^-(x / deviation)^2, of 3 deviations to either side, as published.

    deviation: pixels
    """
    reach = int(3 * deviation)
    if reach < 1:
        return pictures
    line = torch.exp2(-(torch.arange(-reach, reach + 1, device=pictures.device) / deviation).square())
    line, channels = line / line.sum(), pictures.shape[1]
    pictures = conv2d(pictures, line.expand(channels, 1, 1, -1), padding=(0, reach), groups=channels)
    return conv2d(pictures, line[:, None].expand(channels, 1, -1, 1), padding=(reach, 0), groups=channels)
