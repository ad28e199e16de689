"""Networks of HyP-NeRF: the hypernetwork, the field of an instance, the denoiser of pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from ... import kernels
from ...components.fields.hash_field import COLOUR_LAYERS, DENSITY_LAYERS, GEOMETRY_FEATURES, HashNumbers, side_by_side
from ...components.fields.layers import truncated_exp
from ...method import Field
from ...method.field import Colours, Densities, Directions, Points

TABLE, CALM = 1e-4, 0.1  # of a table's first entries; of what codes change at first, beside what all have in common


class HyperNetwork(nn.Module):
    """One perceptron for each tensor (Sen 2023, section 3.2; as in Sitzmann 2020): its last bias is the tensor common
    to all instances, and its last layer's weights span their differences.

    codes:  size of the code of each tensor
    width, layers: of the hidden layers
    shapes: of the tensors; the first one is a table, all others are layers without biases
    """

    def __init__(self, codes: Sequence[int], width: int, layers: int, shapes: Sequence[tuple[int, int]]):
        super().__init__()
        self.shapes = tuple(shapes)
        self.hidden, self.last = nn.ModuleList(), nn.ModuleList()
        for number, (code, (rows, columns)) in enumerate(zip(codes, self.shapes, strict=True)):
            widths = [code, *[width] * layers]
            pairs = zip(widths, widths[1:], strict=False)
            self.hidden.append(nn.Sequential(*(x for a, b in pairs for x in (nn.Linear(a, b), nn.ReLU()))))
            last = nn.Linear(width, rows * columns)
            bound = TABLE if number == 0 else math.sqrt(6 / columns)
            nn.init.uniform_(last.bias, -bound, bound)
            nn.init.normal_(last.weight, std=CALM * bound / math.sqrt(width))
            self.last.append(last)

    def forward(self, codes: Sequence[Float[Tensor, "member _"]]) -> list[list[Float[Tensor, "_ _"]]]:
        """Each member's tensors. codes: for each tensor, those of all members"""
        networks = zip(self.hidden, self.last, self.shapes, codes, strict=True)
        made = [last(hidden(code)).unflatten(1, shape).unbind(0) for hidden, last, shape, code in networks]
        return [list(tensors) for tensors in zip(*made, strict=True)]


@dataclass(frozen=True)
class HashShape:
    """Shapes of a field's tensors: the table, then the density network's layers, then those of the colour network.

    levels: of the table, which covers [-1, 1]^3
    density, colour: widths of the networks' layers, inputs first
    bands:  of spherical harmonics, in which the colour network sees directions
    """

    levels: kernels.HashLevels
    density: tuple[int, ...]
    colour: tuple[int, ...]
    bands: int

    @staticmethod
    def of(numbers: HashNumbers, hidden_width: int) -> HashShape:
        n, width = numbers, hidden_width
        density = (n.width, *[width] * DENSITY_LAYERS, GEOMETRY_FEATURES)
        colour = (GEOMETRY_FEATURES + n.sh_bands**2, *[width] * COLOUR_LAYERS, 3)
        return HashShape(n.levels_of(), density, colour, n.sh_bands)

    @property
    def tensors(self) -> list[tuple[int, int]]:
        """The shape of each tensor."""
        layers = [(b, a) for widths in (self.density, self.colour) for a, b in zip(widths, widths[1:], strict=False)]
        return [(self.levels.entries, self.levels.features), *layers]

    @property
    def of_colour(self) -> list[bool]:
        """True for the tensors of the colour network."""
        return [i >= len(self.density) for i in range(len(self.tensors))]


class HashInstance(Field):
    """Density and colour at points (Müller 2022, figure 3), differentiable in all tensors."""

    def __init__(self, shape: HashShape, tensors: Sequence[Float[Tensor, "_ _"]]):
        super().__init__()
        self.shape, self.tensors = shape, [*tensors]

    def geometry(self, points: Points, code: Tensor | None = None) -> tuple[Densities, Float[Tensor, "point geometry"]]:
        table, layers = self.tensors[0], self.tensors[1 : len(self.shape.density)]
        encoded = kernels.hash_encode(points * 0.5 + 0.5, table.contiguous(), self.shape.levels)
        geometry = kernels.perceptron(encoded, *layers)
        return truncated_exp(geometry[:, 0]), geometry

    def colour(
        self, features: Float[Tensor, "point geometry"], directions: Directions, code: Tensor | None = None
    ) -> Colours:
        harmonics = kernels.spherical_harmonics(directions, self.shape.bands)
        return kernels.perceptron(side_by_side(features, harmonics), *self.tensors[len(self.shape.density) :]).sigmoid()


class PictureDenoiser(nn.Module):
    """A correction of a picture, from a neighbourhood of about 30 pixels: convolutions at full resolution around others
    at half of it, with a larger receptive field.

    width: channels
    """

    def __init__(self, width: int):
        super().__init__()
        self.first = nn.Conv2d(3, width, 3, padding=1)
        self.down = nn.Conv2d(width, 2 * width, 3, stride=2, padding=1)
        self.inner = nn.ModuleList(
            nn.Conv2d(2 * width, 2 * width, 3, padding=dilation, dilation=dilation) for dilation in (1, 2, 3)
        )
        self.up = nn.Conv2d(2 * width, width, 1)
        self.last = nn.Conv2d(width, 3, 3, padding=1)
        nn.init.normal_(self.last.weight, std=1e-3)

    def forward(self, pictures: Float[Tensor, "picture 3 height width"]) -> Float[Tensor, "picture 3 height width"]:
        """sRGB-encoded colours, not clamped."""
        fine = F.relu(self.first(2 * pictures - 1))
        coarse = F.relu(self.down(fine))
        for layer in self.inner:
            coarse = coarse + F.relu(layer(coarse))
        above = F.interpolate(self.up(coarse), fine.shape[-2:], mode="bilinear", align_corners=False)
        return pictures + self.last(F.relu(fine + above))
