"""Rows of three numbers, for the Triton engines."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def load_row(array, r, here, first=0.0):
    """Row r of an (_, 3) array; (first, 0, 0) where it is not here."""
    x = tl.load(array + 3 * r, mask=here, other=first)
    y = tl.load(array + 3 * r + 1, mask=here, other=0.0)
    z = tl.load(array + 3 * r + 2, mask=here, other=0.0)
    return x, y, z


@triton.jit
def store_row(array, r, row, here):
    tl.store(array + 3 * r, row[0], mask=here)
    tl.store(array + 3 * r + 1, row[1], mask=here)
    tl.store(array + 3 * r + 2, row[2], mask=here)
