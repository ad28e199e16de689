"""Numba: blocks are inserted one after another. Each evicts smaller numbers, which move to the next slot."""

import numpy as np
import torch
from numba import njit

from . import EMPTY, PRIMES

P1, P2, P3 = (np.int64(prime) for prime in PRIMES)
NONE = np.int32(EMPTY)


@njit(inline="always")
def slot_of(x, y, z, mask):
    return ((np.int64(x) * P1) ^ (np.int64(y) * P2) ^ (np.int64(z) * P3)) & mask


@njit(error_model="numpy")
def find(x, y, z, blocks, table):
    """Number of the block at coordinates, -1 if there is none."""
    mask = len(table) - 1
    slot = slot_of(x, y, z, mask)
    while True:
        number = table[slot]
        if number == NONE:
            return np.int64(-1)
        if blocks[number, 0] == x and blocks[number, 1] == y and blocks[number, 2] == z:
            return np.int64(number)
        slot = (slot + 1) & mask


@njit(cache=True, error_model="numpy")
def _insert(blocks, table, first):
    mask = len(table) - 1
    for block in range(first, len(blocks)):
        number = np.int32(block)
        slot = slot_of(blocks[block, 0], blocks[block, 1], blocks[block, 2], mask)
        while table[slot] != NONE:
            if table[slot] < number:
                table[slot], number = number, table[slot]
            slot = (slot + 1) & mask
        table[slot] = number


def run(blocks, table, first):
    table = table.clone(memory_format=torch.contiguous_format)
    _insert(blocks.contiguous().numpy(), table.numpy(), first)
    return table
