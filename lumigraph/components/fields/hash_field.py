"""A field in a multiresolution hash table with two tiny networks (Müller et al. 2022)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ... import kernels
from ...errors import LumigraphError
from ...ranges import between
from ..sampling.spaces import Box, Space
from .activations import truncated_exp
from .mlp import MLP

CALM = 0.5  # of the table's rate, that of networks in the open: at all of it one seed in three never learns a hue
WITHIN = 2  # times as fine as asked for, where coordinates are contracted: the box of interest is half as wide in them


@dataclass(frozen=True)
class HashNumbers:
    """A Config's numbers of the table (Müller 2022, table 1)."""

    levels: Annotated[int, between(1, 32)] = 16  # L
    features_per_level: Annotated[int, between(1, 16)] = 2  # F
    log2_hashmap_size: Annotated[int, between(1, 28)] = 19  # log2 T: 14 to 24
    base_resolution: Annotated[int, between(1, 4096)] = 16  # N_min
    max_resolution: Annotated[int, between(1, 1 << 20)] = 2048  # N_max, times the reach (section 5.4)


# Numbers of a Config for a plain CPU, which learn most in a minute (see docs/methods/instant_ngp.md), and for tests.
TABLE_ON_A_CPU: dict[str, Any] = {"levels": 8, "features_per_level": 4, "log2_hashmap_size": 17, "max_resolution": 512}
TINY_TABLE: dict[str, Any] = {"levels": 4, "log2_hashmap_size": 11, "base_resolution": 4, "max_resolution": 32}
ON_A_CPU: dict[str, Any] = {
    **TABLE_ON_A_CPU,
    "hidden_width": 32,
    "samples_per_step": 1 << 15,
    "steps_per_diagonal": 384,
    "transmittance_threshold": 1e-3,
    "cone_angle": 1 / 96,
    "occupancy_threshold": 0.15,
    "learning_rate": 2e-2,
}
TINY: dict[str, Any] = {
    **TINY_TABLE,
    "hidden_width": 16,
    "geometry_features": 8,
    "sh_bands": 2,
    "samples_per_step": 2048,
    "steps_per_diagonal": 128,
    "occupancy_resolution": 16,
    "learning_rate": 2e-2,
}


class HashField(nn.Module):
    """Density from position, colour from position, direction and a code (Müller 2022, figure 3 and section 5.4).

    config: names the numbers of levels, table and networks as `methods.instant_ngp.Config` does
    space:  whose coordinates the table covers
    reach:  half-size of the cube that a scene lies in as it is, where the space leaves it so
    code:   numbers beside the direction that colour depends on, such as a photograph's appearance
    """

    def __init__(self, config: Any, space: Space, reach: float, code: int = 0):
        super().__init__()
        self.extent, finer = (reach, reach) if isinstance(space, Box) else (1.0, WITHIN)
        self.bands, finest = config.sh_bands, int(config.max_resolution * finer)
        self.levels = kernels.HashLevels(
            config.levels, config.features_per_level, config.log2_hashmap_size, config.base_resolution, finest
        )
        self.table = nn.Parameter(torch.empty(self.levels.offsets[-1], config.features_per_level).uniform_(-1e-4, 1e-4))
        hidden = [config.hidden_width] * config.density_layers
        self.density_network = MLP(config.levels * config.features_per_level, *hidden, config.geometry_features)
        hidden = [config.hidden_width] * config.colour_layers
        self.colour_network = MLP(config.geometry_features + self.bands**2 + code, *hidden, 3)

    def encode(
        self, coordinates: Float[Tensor, "sample 3"], weights: Float[Tensor, " level"] | None = None
    ) -> Float[Tensor, "sample width"]:
        """Features of all levels, the coarsest first. weights: of the levels, where not all count fully"""
        encoded = kernels.hash_encode(coordinates * (0.5 / self.extent) + 0.5, self.table, self.levels)
        return encoded if weights is None else encoded * weights.repeat_interleave(self.levels.features)

    def density(
        self, encoded: Float[Tensor, "sample width"]
    ) -> tuple[Float[Tensor, " sample"], Float[Tensor, "sample geometry"]]:
        """Density per unit of the coordinates, and the features of each place that the colour network takes."""
        geometry = self.density_network(encoded)
        return truncated_exp(geometry[:, 0]), geometry

    def colour(
        self,
        geometry: Float[Tensor, "sample geometry"],
        directions: Float[Tensor, "sample 3"],
        *codes: Float[Tensor, "sample code"],
    ) -> Float[Tensor, "sample 3"]:
        """sRGB-encoded colour."""
        harmonics = kernels.spherical_harmonics(directions, self.bands)
        return torch.sigmoid(self.colour_network(side_by_side(geometry, harmonics, *codes)))


def check_levels(config: Any) -> None:
    """Raises LumigraphError for numbers of levels that contradict each other."""
    if config.base_resolution > config.max_resolution:
        raise LumigraphError(
            f"The coarsest level cannot be finer than the finest: --base-resolution {config.base_resolution:,} is "
            f"above --max-resolution {config.max_resolution:,}"
        )
    if config.levels << config.log2_hashmap_size >= 1 << 32:
        raise LumigraphError(
            f"--levels {config.levels} with --log2-hashmap-size {config.log2_hashmap_size} make more entries than "
            f"32 bits count; give a smaller one"
        )


def bytes_kept(config: Any) -> int:
    """Bytes of activations that a step keeps for its gradients at least."""
    hidden = config.hidden_width * (config.density_layers + config.colour_layers)
    return 4 * config.samples_per_step * (config.levels * config.features_per_level + hidden)


def side_by_side(*features: Float[Tensor, "sample _"]) -> Float[Tensor, "sample width"]:
    """Features of samples joined as `kernels.perceptron` reads them quickest, all samples' first one, then the next."""
    return torch.cat([x.t() for x in features]).t()
