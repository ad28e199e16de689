"""Tiling: list of the Gaussians that touch each tile of the picture, sorted by depth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .._operation import Facts, door, implementation, require
from ..project import MIN_ALPHA

FACTS = Facts(unit="gaussians", outputs=2, differentiable=(), typical=2, compiled=6)

SIDE = 32  # pixels along a tile


@dataclass(frozen=True)
class Tiles:
    """Gaussians of each tile: tile k, row by row, has order[starts[k] : starts[k + 1]], front to back.

    size: (width, height) of the picture; side: pixels along a tile. The last tile of a row or column may stick out.
    """

    order: Int[Tensor, " pair"]
    starts: Int[Tensor, " tile_plus_one"]
    size: tuple[int, int]
    side: int

    def to(self, device: torch.device | str) -> Tiles:
        return replace(self, order=self.order.to(device), starts=self.starts.to(device))

    @property
    def across(self) -> int:
        """Tiles in a row."""
        return -(-self.size[0] // self.side)

    @property
    def down(self) -> int:
        """Rows of tiles."""
        return -(-self.size[1] // self.side)


@door
def tile(
    centres: Float[Tensor, "gaussian 2"],
    conics: Float[Tensor, "gaussian 3"],
    opacities: Float[Tensor, " gaussian"],
    depths: Float[Tensor, " gaussian"],
    size: tuple[int, int],
    side: int = SIDE,
) -> Tiles:
    """Lists of the Gaussians that reach 1/255 somewhere between the outermost pixel centres of each tile.

    A footprint is the ellipse d^T conic d <= 2 ln(255 opacity), tighter than a fixed 3 sigma. Equal depths keep the
    order of their numbers.

    size: (width, height) of the picture in pixels
    side: of a tile, in pixels: 4, 8, 16 or 32
    Not differentiable. order is int32, starts int64.
    """
    require(side in (4, 8, 16, 32), f"a tile of side {side} cannot be; it is 4, 8, 16 or 32 pixels")
    require(min(size) > 0, f"a picture cannot have {size[0]} x {size[1]} pixels")
    run = implementation("tile", centres)
    order, starts = run(centres.detach(), conics.detach(), opacities.detach(), depths.detach(), size, side)
    return Tiles(order, starts, size, side)


def cases(generator: torch.Generator):
    """Test inputs for all engines, without ellipses that end on a tile's border."""
    many = (60, (70, 45), 16), (60, (70, 45), 32), (50, (33, 65), 8), (120, (27, 22), 4)
    for count, size, side in ((0, (70, 45), 16), (1, (5, 3), 32), *many):
        yield _steady(*footprints(count, size, generator), size, side)
    centres, conics, opacities, depths = footprints(60, (70, 45), generator)
    depths[10:50] = 2.0  # coincident
    opacities[20:24], opacities[30:33] = 0.0, MIN_ALPHA / 2
    conics[:4] = torch.tensor([1e-6, 0.0, 1e-6])  # everywhere
    conics[4:8] = torch.tensor([0.5, 0.49999, 0.5])  # needles across the picture
    conics[8:10], centres[10:14] = torch.tensor([3.3, 0.0, 3.3]), -500.0
    yield _steady(centres, conics, opacities, depths, (70, 45), 16)


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """Footprints of a few pixels each, on a square picture of `size` pixels with one Gaussian for every 8 of them."""
    width = round(size**0.5)
    return *footprints(size // 8, (width, width), generator), (width, width), SIDE


def footprints(count: int, size: tuple[int, int], generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Centres, conics, opacities and depths of ellipses on and around a picture, a few pixels in size."""

    def uniform(*shape):
        return torch.rand(shape, generator=generator)

    centres = (1.4 * uniform(count, 2) - 0.2) * torch.tensor(size)
    angle, sigma = 3.2 * uniform(count), torch.exp(1.5 * uniform(count, 2))
    c, s, (p, q) = angle.cos(), angle.sin(), sigma.pow(-2).T
    conics = torch.stack([c * c * p + s * s * q, c * s * (p - q), s * s * p + c * c * q], -1)
    return centres, conics, uniform(count), 1 + uniform(count)


def _steady(centres, conics, opacities, depths, size, side):
    """The Gaussians whose tiles stay the same when their opacity changes by more than float32 rounds."""
    from .reference import touches

    fewer, more = (
        touches(centres.double(), conics.double(), opacities.double() * nudge, size, side)
        for nudge in (1 - 1e-3, 1 + 1e-3)
    )
    keep = (fewer == more).all(-1)
    return *(x[keep] for x in (centres, conics, opacities, depths)), size, side
