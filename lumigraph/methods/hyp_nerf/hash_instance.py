"""A field in a hash table whose tensors come from elsewhere: from a hypernetwork, or tuned from what one gave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ... import kernels
from ...components.fields.activations import truncated_exp
from ...components.fields.hash_field import HashNumbers, side_by_side
from ...method import Field


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
        density = (n.width, *[width] * n.density_layers, n.geometry_features)
        colour = (n.geometry_features + n.sh_bands**2, *[width] * n.colour_layers, 3)
        return HashShape(n.levels_of(), density, colour, n.sh_bands)

    @property
    def tensors(self) -> list[tuple[int, int]]:
        """The shape of each tensor."""
        layers = [(b, a) for widths in (self.density, self.colour) for a, b in zip(widths, widths[1:], strict=False)]
        return [(self.levels.entries, self.levels.features), *layers]

    @property
    def of_colour(self) -> list[bool]:
        """Which tensors are the colour network's."""
        return [i >= len(self.density) for i in range(len(self.tensors))]


class HashInstance(Field):
    """Density and colour at points (Müller 2022, figure 3), differentiable in all tensors."""

    def __init__(self, shape: HashShape, tensors: Sequence[Float[Tensor, "_ _"]]):
        super().__init__()
        self.shape, self.tensors = shape, [*tensors]

    def geometry(
        self, points: Float[Tensor, "point 3"], code: Tensor | None = None
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point geometry"]]:
        table, layers = self.tensors[0], self.tensors[1 : len(self.shape.density)]
        encoded = kernels.hash_encode(points * 0.5 + 0.5, table.contiguous(), self.shape.levels)
        geometry = kernels.perceptron(encoded, *layers)
        return truncated_exp(geometry[:, 0]), geometry

    def colour(
        self,
        features: Float[Tensor, "point geometry"],
        directions: Float[Tensor, "point 3"],
        code: Tensor | None = None,
    ) -> Float[Tensor, "point 3"]:
        harmonics = kernels.spherical_harmonics(directions, self.shape.bands)
        return kernels.perceptron(side_by_side(features, harmonics), *self.tensors[len(self.shape.density) :]).sigmoid()
