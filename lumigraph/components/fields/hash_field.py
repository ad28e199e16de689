"""A field in a multiresolution hash table with two small networks (Müller et al. 2022)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ... import kernels
from ...errors import LumigraphError
from ...exchange.packing import Stored
from ...files.ranges import between
from ...method import Field
from ...method.field import Codes, Colours, Densities, Directions, Points
from ..training.row_optimizers import LazyAdam
from .layers import MLP, truncated_exp
from .spaces import Space

OPEN_RATE = 0.5  # of the table's learning rate, for networks in the open: at 1, one seed in three never learns a hue
CODES_RATE = 0.25  # of the learning rate, that of codes beside a hash table
DENSITY_LAYERS = 1  # hidden layers of the density network, section 5.4
COLOUR_LAYERS = 2  # hidden layers of the colour network, section 5.4
GEOMETRY_FEATURES = 16  # features from density to colour network, section 5.4
OPEN_RESOLUTION = 2  # factor on max_resolution where coordinates are contracted: the box of interest is half as wide

Joining = Callable[[int], Tensor | None]  # weights of so many levels or octaves; None where all count fully


@dataclass(frozen=True)
class TableNumbers:
    """A Config's numbers of the hash table (Müller 2022, table 1)."""

    levels: Annotated[int, between(1, 32)] = 16  # levels L of the hash table; more give more detail, and cost time
    features_per_level: Annotated[int, between(1, 16)] = 2  # features F of an entry; more cost memory and time
    log2_hashmap_size: Annotated[int, between(1, 28)] = 19  # log2 of entries T of a level; one more doubles the table
    base_resolution: Annotated[int, between(1, 4096)] = 16  # cells per axis of the coarsest level, N_min
    max_resolution: Annotated[int, between(1, 1 << 20)] = 2048  # cells per axis of the finest level, N_max; times reach

    def check(self) -> None:
        """Raise LumigraphError for inconsistent numbers of levels."""
        if self.base_resolution > self.max_resolution:
            raise LumigraphError(
                f"The coarsest level cannot be finer than the finest: --base-resolution {self.base_resolution:,} is "
                f"above --max-resolution {self.max_resolution:,}"
            )
        if self.levels << self.log2_hashmap_size >= 1 << 32:
            raise LumigraphError(
                f"--levels {self.levels} with --log2-hashmap-size {self.log2_hashmap_size} make more entries than "
                f"32 bits count; give a smaller one"
            )

    def levels_of(self, finer: float = 1.0) -> kernels.HashLevels:
        """Levels of the table. finer: factor on the finest resolution"""
        sizes = self.features_per_level, self.log2_hashmap_size, self.base_resolution
        return kernels.HashLevels(self.levels, *sizes, int(self.max_resolution * finer))

    @property
    def width(self) -> int:
        """Number of features of a point, over all levels."""
        return self.levels * self.features_per_level


@dataclass(frozen=True)
class HashNumbers(TableNumbers):
    """Numbers of the hash table and of the networks behind it (section 5.4)."""

    sh_bands: Annotated[int, between(1, 4)] = 4  # spherical-harmonics bands, section 5.4; 1: no view dependence

    def activation_bytes(self, samples: int, hidden_width: int) -> int:
        """Lower bound of the bytes of activations that a step of so many samples keeps for its gradients."""
        return 4 * samples * (self.width + hidden_width * (DENSITY_LAYERS + COLOUR_LAYERS))


# Tables for a plain CPU, which learn most in a minute (docs/methods/instant_ngp.md), and for tests.
CPU_LEVELS = TableNumbers(levels=8, features_per_level=4, log2_hashmap_size=17, max_resolution=512)
CPU_TABLE = HashNumbers(**vars(CPU_LEVELS))
TINY_LEVELS = TableNumbers(levels=4, log2_hashmap_size=11, base_resolution=4, max_resolution=32)
TINY_TABLE = HashNumbers(**vars(TINY_LEVELS), sh_bands=2)


def new_table(levels: kernels.HashLevels) -> nn.Parameter:
    """Random entries of all levels, close to zero (section 4)."""
    return nn.Parameter(torch.empty(levels.offsets[-1], levels.features).uniform_(-1e-4, 1e-4))


class HashField(Field):
    """Density from position; colour from position, direction and a code (Müller 2022, figure 3 and section 5.4).

    numbers: of table and networks
    space:   defines the table's coordinates
    reach:   half-size of the cube of a bounded scene
    code:    width of a code, input of the colour beside the direction, such as an appearance embedding
    joining: coarse-to-fine weights of the levels; None for no schedule
    layers:  hidden layers of the colour network
    """

    def __init__(
        self,
        numbers: HashNumbers,
        hidden_width: int,
        space: Space,
        reach: float,
        code: int = 0,
        joining: Joining | None = None,
        layers: int = COLOUR_LAYERS,
    ):
        super().__init__()
        n = numbers
        self.space, self.bands, self.joining = space, n.sh_bands, joining
        self.extent, finer = (1.0, OPEN_RESOLUTION) if space.is_open else (reach, reach)
        self.levels = n.levels_of(finer)
        self.table = new_table(self.levels)
        self.density_network = MLP(n.width, *[hidden_width] * DENSITY_LAYERS, GEOMETRY_FEATURES)
        self.colour_network = MLP(GEOMETRY_FEATURES + n.sh_bands**2 + code, *[hidden_width] * layers, 3)

    def encode(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point width"]:
        """Features of all levels, the coarsest first."""
        encoded = kernels.hash_encode(self.space.warp(points) * (0.5 / self.extent) + 0.5, self.table, self.levels)
        weights = self.joining(self.levels.levels) if self.joining else None
        return encoded if weights is None else encoded * weights.repeat_interleave(self.levels.features)

    def geometry(self, points: Points, code: Codes | None = None) -> tuple[Densities, Float[Tensor, "point geometry"]]:
        return self.decode(points, self.encode(points))

    def decode(
        self, points: Float[Tensor, "point 3"], encoded: Float[Tensor, "point width"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point geometry"]]:
        """Density per scene unit and geometry features of encoded points."""
        geometry = self.density_network(encoded)
        return truncated_exp(geometry[:, 0]) * self.space.stretch(points), geometry

    def colour(
        self, features: Float[Tensor, "point geometry"], directions: Directions, code: Codes | None = None
    ) -> Colours:
        harmonics = kernels.spherical_harmonics(directions, self.bands)
        codes = [] if code is None else [code]
        return self.activated(self.colour_network(side_by_side(features, harmonics, *codes)))

    def activated(self, raw: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """sRGB-encoded colour of the colour network's output."""
        return raw.sigmoid()

    def optimizers_at(
        self, learning_rate: float, weight_decay: float = 0.0, scale: float | None = None, groups: Any = ()
    ) -> list[torch.optim.Optimizer]:
        """Adam for the table, updated only at looked-up rows, and for the networks (section 4).

        scale:  relative learning rate of the networks; None for 1, or OPEN_RATE in unbounded scenes
        groups: further groups of parameters
        """
        common: dict[str, Any] = {"lr": learning_rate, "betas": (0.9, 0.99), "eps": 1e-15}
        networks = [*self.density_network.parameters(), *self.colour_network.parameters()]
        group = {"params": networks, "scale": scale or (OPEN_RATE if self.space.is_open else 1.0)}
        table = LazyAdam([self.table], weight_decay=0.0 if self.space.is_open else weight_decay, **common)
        return [table, torch.optim.Adam([group, *groups], foreach=True, **common)]

    def storage(self) -> dict[str, Stored]:
        """Storage: the table as integers, the networks as float16."""
        networks = [name for name, _ in self.named_parameters() if name != "table"]
        return {"table": Stored("scaled"), **dict.fromkeys(networks, Stored("half"))}


def side_by_side(*features: Float[Tensor, "sample _"]) -> Float[Tensor, "sample width"]:
    """Concatenate features of samples in the feature-major layout of `kernels.perceptron`."""
    return torch.cat([x.t() for x in features]).t()
