"""Reference implementation: eight corners a level, looked up and blended."""

import itertools

import torch
from torch import Tensor

from . import PRIMES, HashLevels


def run(points: Tensor, table: Tensor, levels: HashLevels) -> Tensor:
    pyramid = zip(levels.resolutions, table.split(levels.sizes), strict=True)
    return torch.cat([_level(points.clamp(0, 1), n, entries, levels.log2_entries) for n, entries in pyramid], -1)


def _level(points: Tensor, n: int, entries: Tensor, log2_entries: int) -> Tensor:
    """Trilinear interpolation on a grid of n^3 cells."""
    cell = (points.detach() * n).long().clamp(max=n - 1)
    fraction = points * n - cell
    total = entries.new_zeros(len(points), entries.shape[1])
    for place in itertools.product((0, 1), repeat=3):
        corner = torch.tensor(place, device=points.device)
        weight = torch.where(corner == 1, fraction, 1 - fraction).prod(-1)
        total = total + weight[:, None] * entries[_index(cell + corner, n, log2_entries)]
    return total


def _index(corner: Tensor, n: int, log2_entries: int) -> Tensor:
    x, y, z = corner.unbind(-1)
    if (n + 1) ** 3 <= 2**log2_entries:
        return x + (n + 1) * y + (n + 1) ** 2 * z
    return (x * PRIMES[0] ^ y * PRIMES[1] ^ z * PRIMES[2]) % 2**log2_entries
