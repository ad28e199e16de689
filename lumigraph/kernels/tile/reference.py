"""Reference implementation: every Gaussian against every tile, (N, K)."""

import torch
from torch import Tensor

from ..project import MIN_ALPHA


def run(
    centres: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, size: tuple[int, int], side: int
) -> tuple[Tensor, Tensor]:
    near_first = depths.argsort(stable=True)
    touched = touches(centres, conics, opacities, size, side)[near_first]
    tiles, ranks = touched.T.nonzero().unbind(-1)
    starts = torch.nn.functional.pad(torch.bincount(tiles, minlength=touched.shape[1]).cumsum(0), (1, 0))
    return near_first[ranks].int(), starts


def touches(centres: Tensor, conics: Tensor, opacities: Tensor, size: tuple[int, int], side: int) -> Tensor:
    """True if the least q = d^T conic d over each tile's rectangle is at most 2 ln(255 opacity)."""
    width, height = size
    left, top = (torch.arange(0, n, side, device=centres.device).to(centres) + 0.5 for n in size)
    right, bottom = (left + side - 1).clamp(max=width - 0.5), (top + side - 1).clamp(max=height - 0.5)
    rows, columns = len(top), len(left)
    x0, x1 = (x.repeat(rows) - centres[:, :1] for x in (left, right))
    y0, y1 = (y.repeat_interleave(columns) - centres[:, 1:] for y in (top, bottom))
    a, b, c = (conics[:, i : i + 1] for i in range(3))

    # Inside a convex bowl's rectangle the least is at the bottom of the bowl, or else on an edge facing it.
    least = torch.where((x0 <= 0) & (x1 >= 0) & (y0 <= 0) & (y1 >= 0), 0.0, torch.inf).to(centres)
    for x in (x0, x1):
        y = (-b * x / c).clamp(y0, y1)
        least = torch.minimum(least, a * x * x + 2 * b * x * y + c * y * y)
    for y in (y0, y1):
        x = (-b * y / a).clamp(x0, x1)
        least = torch.minimum(least, a * x * x + 2 * b * x * y + c * y * y)
    bright = opacities[:, None] > MIN_ALPHA
    return bright & (least <= 2 * (opacities[:, None] / MIN_ALPHA).clamp_min(1).log())
