"""Rasterisation: footprints of Gaussians are composited front to back."""

import torch
from jaxtyping import Float
from torch import Tensor

from .._operation import Facts, door, implementation, require, require_indices, require_starts
from ..project import MAX_ALPHA, MIN_ALPHA
from ..tile import Tiles, footprints, tile

FACTS = Facts(unit="gaussians", outputs=3, differentiable=(0, 1, 2, 3, 4), typical=3, compiled=3, smooth=(3,))


@door
def rasterize(
    centres: Float[Tensor, "gaussian 2"],
    conics: Float[Tensor, "gaussian 3"],
    opacities: Float[Tensor, " gaussian"],
    colours: Float[Tensor, "gaussian 3"],
    depths: Float[Tensor, " gaussian"],
    tiles: Tiles,
    stop: float = 1e-4,
    exclusive: bool = False,
    spread: Tensor | None = None,
) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width"], Float[Tensor, "height width"]]:
    """Composite each pixel's Gaussians in the order of its tile's list (Kerbl 2023, eq. 3 and appendix C).

        a_i = min(0.99, opacity_i exp(-d^T conic_i d / 2))      d from its centre to the pixel's; 0 if below 1/255
        T_i = prod_{j<i} (1 - a_j)      transmittance
        w_i = a_i T_i                   0 once T_i < stop; with `exclusive` once T_i (1 - a_i) <= stop

    Returns sum_i w_i colour_i (H, W, 3), sum_i w_i depth_i (H, W) and sum_i w_i (H, W). All are differentiable in the
    five tensors; a_i clamped to 0.99 has no gradient.

    exclusive: leave out the Gaussian that ends a ray, as gsplat does
    spread: (N, 2), to which the backward pass adds sum |dL / d centre| over pixels (Ye 2024, arXiv 2404.10484)
    """
    require(len(tiles.starts) == tiles.across * tiles.down + 1, "the tiles do not cover their picture")
    require_starts("tiles.starts", tiles.starts, len(tiles.order))
    require_indices("tiles.order", tiles.order, len(centres))
    require(spread is None or spread.shape == centres.shape, "spread must have the shape of the centres")
    return implementation("rasterize", centres)(
        centres, conics, opacities, colours, depths, tiles, stop, exclusive, spread
    )


def cases(generator: torch.Generator):
    """Test pictures for all engines, without pixels near the thresholds 1/255, 0.99 and `stop`."""
    for count, size, side, stop in [
        (0, (9, 5), 16, 1e-4),
        (1, (1, 1), 32, 1e-4),
        (20, (40, 33), 16, 1e-4),
        (16, (40, 23), 32, 1e-4),
        (40, (27, 21), 8, 1e-2),
    ]:
        yield _steady(*footprints(count, size, generator), size, side, stop, generator)
    centres, conics, opacities, depths = footprints(60, (20, 18), generator)
    conics[:20], opacities[:20] = torch.tensor([0.04, 0.01, 0.05]), 1.0  # so wide that 0.99 cuts off whole pixels
    yield _steady(centres, conics, 0.5 + opacities / 2, depths, (20, 18), 8, 0.1, generator)  # little is seen behind
    centres, conics, opacities, depths = footprints(100, (37, 50), generator)
    yield _steady(centres, conics, 0.5 + opacities / 2, depths, (37, 50), 32, 1e-4, generator)  # walls
    depths = (4 * depths).round()  # coincident
    conics[:10], opacities[:10] = torch.tensor([1e-6, 0.0, 1e-6]), opacities[:10] / 2  # a haze everywhere
    conics[10:20] = torch.tensor([0.5, 0.49999, 0.5])  # needles
    conics[20:30], centres[30:40] = torch.tensor([3.3, 0.0, 3.3]), -500.0
    opacities[40:60] = 0.0
    yield _steady(centres, conics, opacities, depths, (37, 50), 16, 1e-4, generator)
    yield _steady(centres[:60], conics[:60], opacities[:60] / 4, depths[:60], (37, 50), 32, 0.0, generator)
    centres, conics, opacities, depths = footprints(100, (37, 50), generator)
    yield *_steady(centres, conics, 0.5 + opacities / 2, depths, (37, 50), 32, 1e-2, generator), True


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """A square picture of `size` pixels, one Gaussian of a few pixels for every 8 of them."""
    width = round(size**0.5)
    centres, conics, opacities, depths = footprints(size // 8, (width, width), generator)
    colours, tiles = (
        torch.rand(len(centres), 3, generator=generator),
        tile(centres, conics, opacities, depths, (width,) * 2),
    )
    return *(x.requires_grad_() for x in (centres, conics, opacities, colours, depths)), tiles, 1e-4


def _steady(centres, conics, opacities, depths, size, side, stop, generator):
    """The Gaussians without pixels near a threshold. Repeated until none is removed, since removal changes T."""
    from ..tile.reference import run as tile_
    from .reference import light

    colours = torch.rand(len(centres), 3, generator=generator)
    while True:
        tiles = Tiles(*tile_(centres, conics, opacities, depths, size, side), size, side)
        bad = torch.zeros(len(centres), dtype=torch.bool)
        for numbers, _, raw, before in light(centres.double(), conics.double(), opacities.double(), tiles, stop):
            near = torch.zeros_like(raw, dtype=torch.bool)
            behind = before * (1 - raw.clamp(max=MAX_ALPHA))
            for value, threshold in ((raw, MIN_ALPHA), (raw, MAX_ALPHA), (before, stop), (behind, stop)):
                near |= (value / max(threshold, 1e-12) - 1).abs() < 1e-3
            bad[numbers] |= near.any(0)
        if not bad.any():
            return centres, conics, opacities, colours, depths, tiles, stop
        centres, conics, opacities, depths, colours = (x[~bad] for x in (centres, conics, opacities, depths, colours))
