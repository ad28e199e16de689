"""Voxel hashing: a table from the coordinates of blocks of voxels to their numbers."""

import torch
from jaxtyping import Int32
from torch import Tensor

from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="blocks", outputs=1, differentiable=(), typical=3, compiled=3)

PRIMES = 73856093, 19349669, 83492791
SIDE = 8  # voxels along each axis of a block
VOXELS = SIDE**3  # voxels of a block, z fastest
EMPTY = -1  # of a slot without a block


@door
def block_hash(
    blocks: Int32[Tensor, "block 3"], table: Int32[Tensor, " slot"], first: int = 0
) -> Int32[Tensor, " slot"]:
    """The table with the blocks from number `first` on inserted (Nießner 2013, sec. 4.1 and eq. 1).

        h(x, y, z) = (73856093 x xor 19349669 y xor 83492791 z) mod n

    A slot holds the number of a block, or EMPTY. Block i lies in the first slot from h on, cyclically, that no block
    with a larger number holds. So the table does not depend on the order of insertion (Blelloch and Golovin 2007),
    and threads may insert at once.

    blocks: coordinates, each once
    table:  of a power of two slots, more than there are blocks; holds the blocks before `first`. Trusted, as are they
    Not differentiable.
    """
    slots = len(table)
    require(slots & (slots - 1) == 0 and slots > len(blocks), f"{slots} slots are no power of 2 above {len(blocks)}")
    require(0 <= first <= len(blocks), f"the first of {len(blocks)} blocks cannot be {first}")
    return implementation("block_hash", table)(blocks, table, first)


def new_table(blocks: Int32[Tensor, "block 3"]) -> Int32[Tensor, " slot"]:
    """A table that holds all blocks, and is less than half full."""
    empty = torch.full((1 << max(len(blocks), 8).bit_length() + 1,), EMPTY, dtype=torch.int32, device=blocks.device)
    return block_hash(blocks, empty)


def random_blocks(count: int, reach: int, generator: torch.Generator) -> Int32[Tensor, "block 3"]:
    """`count` distinct random coordinates from -reach to reach - 1, for tests."""
    drawn = torch.randperm((2 * reach) ** 3, generator=generator)[:count]
    across = torch.stack([drawn // (2 * reach) ** 2, drawn // (2 * reach) % (2 * reach), drawn % (2 * reach)], -1)
    return (across - reach).int()


def cases(generator: torch.Generator):
    """Test inputs for all engines: an empty table, nearly full ones, blocks that are added later."""
    for count, slots, first in [(0, 1, 0), (1, 2, 0), (3, 4, 1), (60, 64, 0), (60, 64, 41), (100, 256, 30)]:
        blocks = random_blocks(count, 4, generator)
        table = torch.full((slots,), EMPTY, dtype=torch.int32)
        yield blocks, table if first == 0 else implementation("block_hash", table)(blocks[:first], table, 0), first


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """size / 1000 blocks in a table that is less than half full."""
    blocks = random_blocks(max(size // 16, 1), 32, generator)
    return blocks, torch.full((1 << len(blocks).bit_length() + 1,), EMPTY, dtype=torch.int32), 0
