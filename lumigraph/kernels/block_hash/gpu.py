"""Triton: one lane carries one block, or the one it evicts, from slot to slot until one is empty."""

import torch
import triton
import triton.language as tl

from .._gpu import blocks as programs
from .._gpu import indices, launch
from . import EMPTY, PRIMES

P1, P2, P3, NONE = (tl.constexpr(number) for number in (*PRIMES, EMPTY))
BLOCK = tl.constexpr(128)


@triton.jit
def slot_of(x, y, z, mask):
    return ((x.to(tl.int64) * P1) ^ (y.to(tl.int64) * P2) ^ (z.to(tl.int64) * P3)) & mask


@triton.jit
def load_block(blocks, number, here):
    """Coordinates of blocks by their numbers."""
    x = tl.load(blocks + 3 * number, mask=here, other=0)
    y = tl.load(blocks + 3 * number + 1, mask=here, other=0)
    z = tl.load(blocks + 3 * number + 2, mask=here, other=0)
    return x, y, z


@triton.jit
def find(x, y, z, blocks, table, mask, here):
    """Numbers of the blocks at coordinates, -1 where there is none."""
    slot = slot_of(x, y, z, mask)
    found = (slot * 0 - 1).to(tl.int32)
    seeking = here
    while tl.max(seeking.to(tl.int32), 0) > 0:
        number = tl.load(table + slot, mask=seeking, other=NONE)
        seeking = seeking & (number != NONE)
        bx, by, bz = load_block(blocks, number.to(tl.int64), seeking)
        same = seeking & (bx == x) & (by == y) & (bz == z)
        found = tl.where(same, number, found)
        seeking = seeking & (~same)
        slot = (slot + 1) & mask
    return found


@triton.jit(do_not_specialize=["first", "count"])
def _insert(blocks, table, first, count, mask):
    i, here = indices(count, BLOCK)
    number = (first + i).to(tl.int32)
    x, y, z = load_block(blocks, first + i, here)
    slot = slot_of(x, y, z, mask)
    while tl.max(here.to(tl.int32), 0) > 0:
        before = tl.atomic_max(table + slot, number, mask=here)
        here = here & (before != NONE)
        number = tl.minimum(number, before)  # the smaller number goes on, be it evicted or not
        slot = (slot + 1) & mask


def run(blocks, table, first):
    table, count = table.clone(memory_format=torch.contiguous_format), len(blocks) - first
    launch(_insert, (programs(count, BLOCK),), blocks.contiguous(), table, first, count, len(table) - 1)
    return table
