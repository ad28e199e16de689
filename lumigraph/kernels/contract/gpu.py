"""Triton: one program takes a block of points."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from .._dispatch import empty

BLOCK = 256


@triton.jit
def scale_of(x, y, z):
    """1 / |x|, at most 1, and the factor that takes a point into the contraction's ball."""
    inverse = 1.0 / tl.maximum(tl.sqrt(x * x + y * y + z * z), 1.0)
    return inverse, 0.5 * (2.0 - inverse) * inverse


@triton.jit
def stretch_of(inverse, across):
    """|det J|^(1/3) from the two numbers of `scale_of`."""
    return tl.exp2(tl.log2(0.5 * inverse * inverse * across * across) / 3)


@triton.jit
def _contract(points, coordinates, stretch, count, STRETCH: tl.constexpr, BLOCK: tl.constexpr):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    x = tl.load(points + 3 * i, mask=here, other=0.0)
    y = tl.load(points + 3 * i + 1, mask=here, other=0.0)
    z = tl.load(points + 3 * i + 2, mask=here, other=0.0)
    inverse, across = scale_of(x, y, z)
    tl.store(coordinates + 3 * i, across * x, mask=here)
    tl.store(coordinates + 3 * i + 1, across * y, mask=here)
    tl.store(coordinates + 3 * i + 2, across * z, mask=here)
    if STRETCH:
        tl.store(stretch + i, stretch_of(inverse, across), mask=here)


@torch.no_grad()
def run(points: Tensor, stretch: bool) -> tuple[Tensor, Tensor | None]:
    count, device = len(points), points.device
    coordinates, lengths = empty(count, 3, device=device), empty(count if stretch else 0, device=device)
    if count:
        grid = (triton.cdiv(count, BLOCK),)
        _contract[grid](points.contiguous(), coordinates, lengths, count, STRETCH=stretch, BLOCK=BLOCK)
    return coordinates, lengths if stretch else None
