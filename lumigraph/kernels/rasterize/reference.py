"""Reference implementation: every pixel of a tile against every Gaussian of its list, (P, M)."""

from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor

from ..project import MAX_ALPHA, MIN_ALPHA
from ..tile import Tiles


def run(
    centres: Tensor,
    conics: Tensor,
    opacities: Tensor,
    colours: Tensor,
    depths: Tensor,
    tiles: Tiles,
    stop: float,
    exclusive: bool = False,
    spread: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    width, height = tiles.size
    values = torch.cat([colours, depths[:, None], torch.ones_like(depths)[:, None]], -1)
    parts, places = [centres.new_zeros(0, 5)], [torch.zeros(0, dtype=torch.int64, device=centres.device)]
    for numbers, pixels, raw, T in light(centres, conics, opacities, tiles, stop, spread):
        alpha = torch.where(raw < MIN_ALPHA, 0, raw.clamp(max=MAX_ALPHA))
        ended = T * (1 - alpha) <= stop if exclusive else T < stop
        weights = torch.where(ended, 0, alpha * T)
        parts.append(weights @ values[numbers])
        places.append(pixels[:, 1] * width + pixels[:, 0])
    seen = centres.new_zeros(height * width, 5).index_copy(0, torch.cat(places), torch.cat(parts))
    return seen[:, :3].view(height, width, 3), seen[:, 3].view(height, width), seen[:, 4].view(height, width)


def light(
    centres: Tensor, conics: Tensor, opacities: Tensor, tiles: Tiles, stop: float, spread: Tensor | None = None
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """For each tile: numbers of its Gaussians (M,), its pixels' columns and rows (P, 2), opacity exp(-q / 2) before any
    threshold (P, M), and transmittance T (P, M)."""
    width, height = tiles.size
    for k in range(tiles.across * tiles.down):
        numbers = tiles.order[tiles.starts[k] : tiles.starts[k + 1]].long()
        x = torch.arange(tiles.side, device=centres.device) + k % tiles.across * tiles.side
        y = torch.arange(tiles.side, device=centres.device) + k // tiles.across * tiles.side
        pixels = torch.cartesian_prod(y[y < height], x[x < width]).flip(-1)
        d = pixels[:, None] + 0.5 - centres[numbers]
        if spread is not None and d.requires_grad:
            d.register_hook(partial(_add_absolute, spread, numbers))
        (dx, dy), (a, b, c) = d.unbind(-1), conics[numbers].unbind(-1)
        raw = opacities[numbers] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
        alpha = torch.where(raw < MIN_ALPHA, 0, raw.clamp(max=MAX_ALPHA))
        T = torch.nn.functional.pad(1 - alpha, (1, 0), value=1.0).cumprod(1)[:, :-1]
        yield numbers, pixels, raw, T


def _add_absolute(spread: Tensor, numbers: Tensor, gradient: Tensor) -> None:
    spread.index_add_(0, numbers, gradient.abs().sum(0).to(spread))
