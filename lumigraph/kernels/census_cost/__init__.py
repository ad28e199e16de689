"""Census matching cost of a rectified pair: difference in the order of brightness around two pixels."""

import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="pixels", unit_axes=2, outputs=1, differentiable=(), typical=2, compiled=2)

OFFSETS = [(x, y) for y in range(-2, 3) for x in range(-3, 4) if (x, y) != (0, 0) and abs(x) + abs(y) < 5]
REACH = 3  # pixels from the centre to the farthest of OFFSETS, along an axis
DIFFERENCE_SHIFT, MAX_DIFFERENCE = 1, 10  # of grey levels: divided by two, and limited
UNSEEN_COST = 10  # of a pixel that the other picture does not show, about that of an unlike one
MAX_COST = len(OFFSETS) + MAX_DIFFERENCE


@door
def census_cost(
    left: UInt8[Tensor, "height width"],
    right: UInt8[Tensor, "height width"],
    left_valid: Bool[Tensor, "height width"],
    right_valid: Bool[Tensor, "height width"],
    first: int,
    count: int,
) -> UInt8[Tensor, "height width disparity"]:
    """Cost of each disparity d = first + k, k < count, at each pixel of the left picture: the census transform
    (Zabih & Woodfill 1994) and the absolute difference (Mei 2011).

    The signature of a pixel has a bit for each of 30 neighbours, 5 rows of 7 columns without corners: 1 where the
    neighbour is darker. With a pixel (x, y) on the left and (x - d, y) on the right,

        cost = bits in which the signatures differ + min(|difference of grey| / 2, 10)

    in whole numbers, at most MAX_COST, and UNSEEN_COST where one of the two is not valid or outside the picture.
    Beyond a border, the picture's border pixels are repeated. Not differentiable.
    """
    require(count > 0, f"{count} disparities cannot be compared")
    return implementation("census_cost", left)(left, right, left_valid, right_valid, first, count)


def cases(generator: torch.Generator):
    """Test inputs for all engines: tiny pictures, negative disparities, masks, ranges beyond the width."""
    for height, width, first, count in [(1, 1, 0, 1), (2, 3, -2, 5), (7, 20, 0, 9), (6, 9, 3, 20), (5, 11, -14, 6)]:
        yield _inputs(height, width, first, count, generator)
    left, right, _, right_valid, first, count = _inputs(4, 12, 0, 4, generator)
    yield left, right, torch.zeros_like(right_valid), right_valid, first, count
    yield left, left.flip(1).contiguous(), torch.ones_like(right_valid), torch.ones_like(right_valid), first, count
    flat = torch.full_like(left, 255)
    yield flat, torch.zeros_like(left), right_valid, right_valid, first, count


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """A picture of `size` pixels, 64 disparities."""
    side = max(round(size**0.5), 1)
    return _inputs(side, side, 0, 64, generator)


def _inputs(height, width, first, count, generator):
    left, right = torch.randint(0, 256, (2, height, width), generator=generator, dtype=torch.uint8)
    left_valid, right_valid = torch.rand(2, height, width, generator=generator) > 0.1
    return left, right, left_valid, right_valid, first, count
