"""Multiresolution hash encoding of points."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="samples", outputs=1, differentiable=(0, 1), typical=2, compiled=3, smooth=(8,))

PRIMES = (1, 2_654_435_761, 805_459_861)  # section 3; the first is 1 so that neighbours in x stay neighbours

# Of HashLevels, least and most: corners along an axis, and entries, are numbered in 32 bits.
LIMITS = (
    ("levels", 1, 64),
    ("features", 1, 64),
    ("log2_entries", 1, 30),
    ("coarsest", 1, 1 << 30),
    ("finest", 1, 1 << 30),
)


@dataclass(frozen=True)
class HashLevels:
    """Grid sizes of a pyramid: N_l = floor(N_min b^l), with b such that the last is N_max (Müller 2022, eqs. 2, 3).

    A level whose (N_l + 1)^3 corners fit into 2^log2_entries has them all (no collisions); finer ones are hashed.
    """

    levels: int = 16
    features: int = 2
    log2_entries: int = 19
    coarsest: int = 16
    finest: int = 2048

    def __post_init__(self) -> None:
        for name, least, most in LIMITS:
            require(least <= getattr(self, name) <= most, f"{self} cannot be: {name} is from {least} to {most:,}")
        require(self.entries < 1 << 32, f"{self} has {self.entries:,} entries, which 32 bits do not count")

    @property
    def resolutions(self) -> list[int]:
        growth = (self.finest / self.coarsest) ** (1 / max(self.levels - 1, 1))
        return [int(self.coarsest * growth**level + 1e-9) for level in range(self.levels)]

    @property
    def sizes(self) -> list[int]:
        """Entries per level."""
        return [min((n + 1) ** 3, 2**self.log2_entries) for n in self.resolutions]

    @property
    def offsets(self) -> list[int]:
        """First entry of each level in the table, then the number of entries of all."""
        offsets = [0]
        for size in self.sizes:
            offsets.append(offsets[-1] + size)
        return offsets

    @cached_property
    def entries(self) -> int:
        """Entries of all levels."""
        return sum(self.sizes)


@door
def hash_encode(
    points: Float[Tensor, "sample 3"], table: Float[Tensor, "entry feature"], levels: HashLevels
) -> Float[Tensor, "sample width"]:
    """Trilinear interpolation of each level's features around each point (Müller 2022, section 3).

    Level l scales the point by N_l and blends the eight corners c of its cell. A corner's entry is
        c_x + (N_l + 1) c_y + (N_l + 1)^2 c_z                    where all corners fit,
        (c_x p_0 xor c_y p_1 xor c_z p_2) mod 2^log2_entries     elsewhere (eq. 4, 32-bit unsigned).

    points: in the unit cube; those outside are clamped to it. The point 1.0 belongs to the last cell.
    table:  (levels.offsets[-1], levels.features), all levels end to end
    Returns (S, levels * features), level by level; differentiable in the table and in the points (a clamped
    coordinate gets no gradient).
    """
    wanted = levels.entries, levels.features
    require(table.shape == wanted, f"a table of shape {tuple(table.shape)} should be {wanted}")
    return implementation("hash_encode", points)(points, table, levels)


def cases(generator: torch.Generator):
    """Test inputs for all engines: dense and hashed levels, every border of the cube, and beyond it."""
    mixed = HashLevels(levels=4, features=2, log2_entries=9, coarsest=3, finest=40)
    for samples in (0, 1, 63, 129):
        yield _inputs(samples, mixed, generator)
    yield _inputs(63, HashLevels(levels=1, features=1, log2_entries=8, coarsest=1), generator)
    yield _inputs(200, HashLevels(levels=3, features=1, log2_entries=6, coarsest=4, finest=9), generator)
    yield _inputs(129, HashLevels(levels=2, features=4, log2_entries=12, coarsest=15, finest=2048), generator)
    _, table, levels = _inputs(0, mixed, generator)
    yield torch.cartesian_prod(*[torch.tensor([-0.5, 0.0, 0.28125, 1.0, 1.5])] * 3), table, levels
    small = HashLevels(levels=2, features=1, log2_entries=5, coarsest=2, finest=5)
    off_the_planes = torch.tensor([[0.1, 0.3, 0.9], [0.7, 1.2, -0.1]])  # of the grid, where the slope jumps
    yield off_the_planes, torch.arange(float(small.offsets[-1])).sin()[:, None], small


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """Samples as in a training step: runs of 32 through the unit cube, two of Instant-NGP's steps (sqrt(3) / 1024)
    apart. Points get no gradient there."""
    levels = HashLevels(levels=16, features=2, log2_entries=17)
    start = 0.2 + 0.6 * torch.rand(size // 32, 1, 3, generator=generator)
    direction = torch.nn.functional.normalize(torch.randn(size // 32, 1, 3, generator=generator), dim=-1)
    points = (start + direction * torch.arange(32)[:, None] * 3**0.5 / 512).reshape(-1, 3)
    table = 1e-4 * (2 * torch.rand(levels.offsets[-1], levels.features, generator=generator) - 1)
    return points, table.requires_grad_(), levels


def _inputs(samples: int, levels: HashLevels, generator: torch.Generator):
    """Random points and table. Points are multiples of 2^-12, so that cells do not depend on rounding."""
    points = torch.randint(-(2**9), 2**12 + 2**9, (samples, 3), generator=generator) / 2**12
    table = 2 * torch.rand(levels.offsets[-1], levels.features, generator=generator) - 1
    return points, table, levels
