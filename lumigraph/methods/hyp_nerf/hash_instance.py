"""A field in a hash table whose tensors come from elsewhere: from a hypernetwork, or tuned from what one gave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ... import kernels
from .activations import truncated_exp
from .hash_field import side_by_side


@dataclass(frozen=True)
class HashShape:
    """What a field's tensors look like: the table, then the density network's layers, then those of the colour network.

    levels: of the table, which covers [-1, 1]^3
    density, colour: widths of the networks' layers, inputs first
    bands:  of spherical harmonics, in which the colour network sees directions
    """

    levels: kernels.HashLevels
    density: tuple[int, ...]
    colour: tuple[int, ...]
    bands: int

    @staticmethod
    def of(config: Any) -> HashShape:
        """config: names the numbers of levels, table and networks as `methods.instant_ngp.Config` does"""
        c, width = config, config.hidden_width
        levels = kernels.HashLevels(
            c.levels, c.features_per_level, c.log2_hashmap_size, c.base_resolution, c.max_resolution
        )
        density = (c.levels * c.features_per_level, *[width] * c.density_layers, c.geometry_features)
        return HashShape(
            levels, density, (c.geometry_features + c.sh_bands**2, *[width] * c.colour_layers, 3), c.sh_bands
        )

    @property
    def tensors(self) -> list[tuple[int, int]]:
        """The shape of each tensor."""
        layers = [(b, a) for widths in (self.density, self.colour) for a, b in zip(widths, widths[1:], strict=False)]
        return [(self.levels.entries, self.levels.features), *layers]

    @property
    def of_colour(self) -> list[bool]:
        """Which tensors are the colour network's."""
        return [i >= len(self.density) for i in range(len(self.tensors))]


@dataclass(frozen=True)
class HashInstance:
    """Density and colour at points (Müller 2022, figure 3), differentiable in all tensors."""

    shape: HashShape
    tensors: Sequence[Float[Tensor, "_ _"]]

    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions."""
        geometry = self._geometry(points)
        harmonics = kernels.spherical_harmonics(directions, self.shape.bands)
        raw = kernels.perceptron(side_by_side(geometry, harmonics), *self.tensors[len(self.shape.density) :])
        return truncated_exp(geometry[:, 0]), torch.sigmoid(raw)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit."""
        return truncated_exp(self._geometry(points)[:, 0])

    def _geometry(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point geometry"]:
        table, layers = self.tensors[0], self.tensors[1 : len(self.shape.density)]
        encoded = kernels.hash_encode(points * 0.5 + 0.5, table.contiguous(), self.shape.levels)
        return kernels.perceptron(encoded, *layers)
