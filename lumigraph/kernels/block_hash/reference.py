"""Reference implementation in PyTorch: all blocks probe in lockstep until each has a slot."""

import torch

from . import EMPTY, PRIMES


def slot_of(coordinates, slots):
    """h of coordinates (..., 3), int64."""
    x, y, z = (prime * coordinates[..., axis].long() for axis, prime in enumerate(PRIMES))
    return (x ^ y ^ z) & (slots - 1)


def find(coordinates, blocks, table):
    """Numbers of the blocks at coordinates (..., 3), -1 where there is none."""
    slot = slot_of(coordinates, len(table))
    found, seeking = torch.full_like(slot, -1), torch.ones_like(slot, dtype=torch.bool)
    while seeking.any():
        number = table[slot].long()
        seeking = seeking & (number != EMPTY)
        here = torch.where(seeking, number, 0)
        same = seeking & (blocks[here] == coordinates).all(-1) if len(blocks) else seeking
        found = torch.where(same, here, found)
        seeking = seeking & ~same
        slot = (slot + 1) & (len(table) - 1)
    return found


def run(blocks, table, first):
    table, number = table.clone(), torch.arange(first, len(blocks), dtype=torch.int32, device=blocks.device)
    slot = slot_of(blocks[first:], len(table))
    while len(number):
        before = table[slot]
        table.scatter_reduce_(0, slot, number, "amax")
        now = table[slot]
        lost = number != now
        evicted = ~lost & (before != EMPTY)
        number = torch.cat([number[lost], before[evicted]])
        slot = (torch.cat([slot[lost], slot[evicted]]) + 1) & (len(table) - 1)
    return table
