"""NeRF-SH: fields of density and spherical harmonics, which depend on the position alone (Yu 2021, section 3.1)."""

from __future__ import annotations

from abc import abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ... import kernels
from ...components.fields.coordinate_network import PositionNetwork
from ...components.fields.hash_field import TableNumbers, new_table
from ...components.fields.layers import MLP, truncated_exp
from ...components.training.row_optimizers import LazyAdam
from ...method import Field
from ...method.field import Colours, Densities, Directions, Points


class SphericalHarmonicsField(Field):
    """Density per scene unit; features are harmonics before the sigmoid, colours next to each other."""

    def colour(
        self, features: Float[Tensor, "point harmonic"], directions: Directions, code: Tensor | None = None
    ) -> Colours:
        """sigmoid(sum of coefficients times basis), eq. 3."""
        harmonics = features.unflatten(1, (-1, 3))
        basis = kernels.spherical_harmonics(directions, round(harmonics.shape[1] ** 0.5))
        return (basis[:, :, None] * harmonics).sum(1).sigmoid()


class HarmonicTeacher(SphericalHarmonicsField):
    """A field that learns from photographs before it is baked. bands: of spherical harmonics"""

    @abstractmethod
    def optimizers_at(self, learning_rate: float) -> list[torch.optim.Optimizer]:
        """Fresh optimizers."""


class HarmonicHash(HarmonicTeacher):
    """A hash table and one tiny network (Müller 2022), over [-1, 1]^3."""

    def __init__(self, numbers: TableNumbers, layers: int, width: int, bands: int):
        super().__init__()
        self.levels = numbers.levels_of()
        self.table = new_table(self.levels)
        self.network = MLP(numbers.width, *[width] * layers, 1 + 3 * bands**2)

    def geometry(self, points: Points, code: Tensor | None = None) -> tuple[Densities, Float[Tensor, "point harmonic"]]:
        raw = self.network(kernels.hash_encode(points * 0.5 + 0.5, self.table, self.levels))
        return truncated_exp(raw[:, 0]), raw[:, 1:]

    def optimizers_at(self, learning_rate: float) -> list[torch.optim.Optimizer]:
        networks = torch.optim.Adam(self.network.parameters(), learning_rate, (0.9, 0.99), 1e-15, foreach=True)
        return [LazyAdam([self.table], learning_rate), networks]


class HarmonicNetwork(HarmonicTeacher):
    """The paper's network: NeRF's layers, which see no direction, then density and harmonics."""

    def __init__(self, octaves: int, depth: int, width: int, skip_layer: int, bands: int):
        super().__init__()
        self.network = PositionNetwork(octaves, depth, width, skip_layer, 1 + 3 * bands**2)

    def geometry(self, points: Points, code: Tensor | None = None) -> tuple[Densities, Float[Tensor, "point harmonic"]]:
        raw = self.network(points)
        return nn.functional.softplus(raw[:, 0]), raw[:, 1:]

    def optimizers_at(self, learning_rate: float) -> list[torch.optim.Optimizer]:
        return [torch.optim.Adam(self.parameters(), lr=learning_rate, eps=1e-7)]
