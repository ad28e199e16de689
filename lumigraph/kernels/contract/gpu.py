"""Triton: one program takes a block of points."""

import triton
import triton.language as tl

from .._gpu import blocks, indices, launch, load_row, store_row
from .._operation import empty

BLOCK = tl.constexpr(256)


@triton.jit
def scale_of(x, y, z):
    """1 / |x|, at most 1, and the contraction's scale factor c(x) / x."""
    inverse = 1.0 / tl.maximum(tl.sqrt(x * x + y * y + z * z), 1.0)
    return inverse, 0.5 * (2.0 - inverse) * inverse


@triton.jit
def stretch_of(inverse, across):
    """|det J|^(1/3) from the results of `scale_of`."""
    return tl.exp2(tl.log2(0.5 * inverse * inverse * across * across) / 3)


@triton.jit
def _contract(points, coordinates, stretch, count, STRETCH: tl.constexpr):
    i, here = indices(count, BLOCK)
    x, y, z = load_row(points, i, here)
    inverse, across = scale_of(x, y, z)
    store_row(coordinates, i, (across * x, across * y, across * z), here)
    if STRETCH:
        tl.store(stretch + i, stretch_of(inverse, across), mask=here)


def run(points, stretch):
    count, device = len(points), points.device
    coordinates, lengths = empty(count, 3, device=device), empty(count if stretch else 0, device=device)
    launch(_contract, (blocks(count, BLOCK),), points.contiguous(), coordinates, lengths, count, STRETCH=stretch)
    return coordinates, lengths if stretch else None
