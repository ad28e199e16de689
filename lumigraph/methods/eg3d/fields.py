"""Fields that a generator makes of styles: three planes (Chan 2022), or sines with frequencies and phases (pi-GAN)."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...components.training.adversarial import EqualisedLinear
from ...kernels import factor_grid
from ...kernels.factor_grid import Factors
from .networks import PlaneDecoder, Styles, SynthesisNetwork, clamped

Made = Float[Tensor, "picture row number"]
Points = Float[Tensor, "point 3"]
Found = tuple[Float[Tensor, " point"], Float[Tensor, "point feature"]]


class MadeField(nn.Module):
    """Generates fields from styles: `made(styles)` is a field for each picture, `found` evaluates it at points.

    styles: number of styles; density is before its activation, features are in [0, 1], the first three colours
    """

    styles: int

    @abstractmethod
    def made(self, styles: Styles, generator: torch.Generator | None = None) -> Made:
        """Tensors of each field. generator: of noise, in training"""

    @abstractmethod
    def found(self, made: Float[Tensor, "row number"], points: Points) -> Found:
        """Density and features of one field at points of the cube [-1, 1]^3."""


class PlaneField(MadeField):
    """Tri-planes: features on the planes YZ, XZ and XY, averaged and decoded (Chan 2022, section 4.1).

    Each plane lies across an axis of its own. The planes are those of `factor_grid`, with ones along the axes.
    size: nodes across a plane; widths: see `SynthesisNetwork`; decoder: hidden channels
    """

    ones: Tensor

    def __init__(self, channels: int, widths: Sequence[int], style: int, decoder: int, features: int):
        super().__init__()
        self.size = 4 << (len(widths) - 1)
        self.channels = channels
        self.synthesis = SynthesisNetwork(3 * channels, widths, style)
        self.decoder = PlaneDecoder(channels, decoder, features)
        self.styles = self.synthesis.styles
        self.register_buffer("ones", torch.ones(3 * self.size, channels), persistent=False)

    def made(self, styles, generator=None):
        planes = self.synthesis(styles, generator).unflatten(1, (3, self.channels))
        return planes.permute(0, 1, 3, 4, 2).flatten(1, 3)

    def found(self, made, points):
        table = torch.cat([made, self.ones])
        features = factor_grid(0.5 * (points + 1), table, Factors("vm", (self.size,) * 3))
        return self.decoder(features.view(len(points), 3, self.channels).mean(1))


SINE_SCALE, SINE_SHIFT = 15.0, 30.0  # of frequencies, as pi-GAN's code has them
SINE_GAIN = 25.0  # in the range of weights at first


class FilmField(MadeField):
    """Layers x' = sin(f (W x + b) + p) with frequencies f and phases p from styles (Chan 2021, pi-GAN, eqs. 1 to 3)."""

    def __init__(self, width: int, layers: int, style: int, features: int):
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(3 if i == 0 else width, width) for i in range(layers))
        self.modulations = nn.ModuleList(EqualisedLinear(style, 2 * width) for _ in range(layers))
        self.out = nn.Linear(width, 1 + features)
        self.styles = layers
        with torch.no_grad():
            for i, layer in enumerate([*self.layers, self.out]):
                inputs = layer.weight.shape[1]
                layer.weight.uniform_(-1, 1).mul_(1 / 3 if i == 0 else math.sqrt(6 / inputs) / SINE_GAIN)

    def made(self, styles, generator=None):
        return torch.stack([layer(styles[:, i]) for i, layer in enumerate(self.modulations)], 1)

    def found(self, made, points):
        x = points
        for layer, modulation in zip(self.layers, made, strict=True):
            frequency, phase = modulation.chunk(2)
            x = torch.sin((SINE_SCALE * frequency + SINE_SHIFT) * layer(x) + phase)
        y = self.out(x)
        return y[:, 0], clamped(y[:, 1:])
