"""Numba: blocks in the order of their numbers, so that none is ever evicted."""

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
    for number in range(first, len(blocks)):
        slot = slot_of(blocks[number, 0], blocks[number, 1], blocks[number, 2], mask)
        while table[slot] != NONE:
            slot = (slot + 1) & mask
        table[slot] = number


def run(blocks, table, first):
    table = table.clone(memory_format=torch.contiguous_format)
    _insert(blocks.contiguous().numpy(), table.numpy(), first)
    return table
