"""Semi-global matching: disparities of least matching cost and smoothness penalty."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="pixels", unit_axes=2, outputs=3, differentiable=(), typical=2, compiled=2)

PATHS = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)]  # (dx, dy), from pixel to pixel
NO_RIVAL = 65535  # sum of costs of a rival where there is none


@door
def semi_global(
    costs: UInt8[Tensor, "height width disparity"],
    guide: UInt8[Tensor, "height width"],
    penalties: UInt8[Tensor, "256"],
    slope_penalty: int,
    first: int,
) -> tuple[Float[Tensor, "height width"], Float[Tensor, "height width"], Float[Tensor, "height width"]]:
    """Disparity of the left picture, of the right one, and margin of the left (Hirschmüller 2008, eq. 13).

    Along eight directions r, from the border to each pixel p,

        L(p, d) = C(p, d) - m + min(L(p - r, d), L(p - r, d - 1) + P1, L(p - r, d + 1) + P1, m + P2)
        m = min over e of L(p - r, e)      S(p, d) = sum of L over the directions

    P1 is `slope_penalty`; P2 is `penalties` at the difference of `guide` between p and p - r, less at edges. At the
    border L = C. The left disparity is first + k for the least S(p, k), the smallest of equal ones, moved between
    whole numbers where both neighbours a, b of the least s exist: by (a - b) / (2 (max(a, b) - s)). The right one is
    the best of S((x + first + k, y), k), whole, or first - 1 where no pixel of the left meets it. The margin is the
    cost of the best disparity that is not beside the least, less the least; NO_RIVAL is that cost if there is none.

    All is in whole numbers; costs + penalties + slope_penalty must stay below 256. Not differentiable.
    """
    require(costs.shape[2] > 0, "no disparities to choose from")
    if costs.numel() and not costs.is_cuda:
        most = int(costs.max()) + int(penalties.max()) + slope_penalty
        require(0 <= slope_penalty and most < 256, f"costs and penalties go up to {most}, and must stay below 256")
    return implementation("semi_global", costs)(costs, guide, penalties, slope_penalty, first)


def cases(generator: torch.Generator):
    """Test inputs for all engines: one pixel, one disparity, ties, flat and strong penalties."""
    for height, width, count, first in [(1, 1, 1, 0), (1, 6, 5, -2), (7, 9, 16, 0), (8, 3, 3, 2), (4, 10, 33, -9)]:
        yield _inputs(height, width, count, first, generator)
    costs, guide, penalties, slope, first = _inputs(5, 8, 7, 0, generator)
    yield torch.zeros_like(costs), guide, penalties, slope, first
    yield costs, guide, torch.zeros_like(penalties), 0, first
    yield costs[:0], guide[:0], penalties, slope, first


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """A picture of `size` pixels, 64 disparities."""
    side = max(round(size**0.5), 1)
    return _inputs(side, side, 64, 0, generator)


def _inputs(height, width, count, first, generator):
    costs = torch.randint(0, 41, (height, width, count), generator=generator, dtype=torch.uint8)
    guide = torch.randint(0, 256, (height, width), generator=generator, dtype=torch.uint8)
    return costs, guide, torch.arange(160, -96, -1).clamp_min(32).to(torch.uint8), 16, first
