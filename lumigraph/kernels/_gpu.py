"""Triton helpers: kernel launches, masked loads of rows of three numbers."""

import triton
import triton.language as tl


def blocks(count: int, block: tl.constexpr) -> int:
    """Number of blocks for `count` elements."""
    return triton.cdiv(count, block.value)


def launch(kernel, grid: tuple[int, ...], *arguments, **options) -> None:
    """Launch a kernel on a grid; do nothing for an empty grid."""
    if all(grid):
        kernel[grid](*arguments, **options)


@triton.jit
def indices(count, BLOCK: tl.constexpr):
    """Element indices of this program's block, and a mask of those below the count."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    return i, i < count


@triton.jit
def load_row(array, r, here, first=0.0):
    """Row r of an (_, 3) array; (first, 0, 0) where masked out."""
    x = tl.load(array + 3 * r, mask=here, other=first)
    y = tl.load(array + 3 * r + 1, mask=here, other=0.0)
    z = tl.load(array + 3 * r + 2, mask=here, other=0.0)
    return x, y, z


@triton.jit
def store_row(array, r, row, here):
    tl.store(array + 3 * r, row[0], mask=here)
    tl.store(array + 3 * r + 1, row[1], mask=here)
    tl.store(array + 3 * r + 2, row[2], mask=here)
