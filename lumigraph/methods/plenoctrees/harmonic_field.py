"""NeRF-SH: fields that give density and harmonics at a place, whatever the direction (Yu 2021, section 3.1)."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ... import kernels
from .activations import truncated_exp
from .dense import Dense, in_chunks
from .encodings import FrequencyEncoding
from .mlp import MLP

Answer = tuple[Float[Tensor, " sample"], Float[Tensor, "sample basis 3"]]


class HarmonicHash(nn.Module):
    """A hash table and one tiny network (Müller 2022) whose outputs are density and harmonics.

    config: names the numbers of the table and the network as `methods.plenoctrees.Config` does
    """

    def __init__(self, config: Any):
        super().__init__()
        c = config
        self.levels = kernels.HashLevels(
            c.levels, c.features_per_level, c.log2_hashmap_size, c.base_resolution, c.max_resolution
        )
        self.table = nn.Parameter(torch.empty(self.levels.offsets[-1], c.features_per_level).uniform_(-1e-4, 1e-4))
        self.basis = c.sh_bands**2
        hidden = [c.hidden_width] * c.hidden_layers
        self.network = MLP(c.levels * c.features_per_level, *hidden, 1 + 3 * self.basis)

    def forward(self, points: Float[Tensor, "sample 3"]) -> Answer:
        """Density per scene unit; harmonics before the sigmoid."""
        found = self.network(kernels.hash_encode(points * 0.5 + 0.5, self.table, self.levels))
        return truncated_exp(found[:, 0]), found[:, 1:].unflatten(1, (self.basis, 3))

    def density(self, points: Float[Tensor, "sample 3"]) -> Float[Tensor, " sample"]:
        """Density per scene unit."""
        return self(points)[0]


class HarmonicNetwork(nn.Module):
    """The paper's network: NeRF's layers, which see no direction, then density and harmonics."""

    def __init__(self, config: Any):
        super().__init__()
        c = config
        self.encode = FrequencyEncoding(3, c.position_frequencies, keep_input=False)
        inputs, width, skip = self.encode.width, c.hidden_width, min(c.skip_layer, c.depth - 1)

        def layers(first: int, count: int) -> nn.Sequential:
            return nn.Sequential(*(Dense(width if i else first, width, True) for i in range(count)))

        self.before, self.after = layers(inputs, skip), layers(width + inputs, c.depth - skip)
        self.basis = c.sh_bands**2
        self.last = Dense(width, 1 + 3 * self.basis)

    def forward(self, points: Float[Tensor, "sample 3"]) -> Answer:
        """Density per scene unit; harmonics before the sigmoid."""
        density, harmonics = in_chunks(self._answer, points)
        return density, harmonics

    def density(self, points: Float[Tensor, "sample 3"]) -> Float[Tensor, " sample"]:
        """Density per scene unit."""
        return self(points)[0]

    def _answer(self, points: Float[Tensor, "sample 3"]) -> Answer:
        position = self.encode(points)
        position = position.to(self.last.type_of_products(position))
        found = self.last(self.after(torch.cat([position, self.before(position)], -1))).float()
        return nn.functional.softplus(found[:, 0]), found[:, 1:].unflatten(1, (self.basis, 3))


def colour(
    harmonics: Float[Tensor, "sample basis 3"], directions: Float[Tensor, "sample 3"]
) -> Float[Tensor, "sample 3"]:
    """sRGB-encoded: sigmoid(sum of coefficients times basis), eq. 3."""
    basis = kernels.spherical_harmonics(directions, round(harmonics.shape[1] ** 0.5))
    return (basis[:, :, None] * harmonics).sum(1).sigmoid()
