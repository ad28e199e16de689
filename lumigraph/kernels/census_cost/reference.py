"""Reference implementation: signatures as bit planes, one disparity after the other."""

import torch
from torch import Tensor

from . import DIFFERENCE_SHIFT, MAX_DIFFERENCE, OFFSETS, UNSEEN_COST


def run(left, right, left_valid, right_valid, first, count) -> Tensor:
    bits, its_bits = signature(left), signature(right)
    x = torch.arange(left.shape[1], device=left.device)
    costs = []
    for d in range(first, first + count):
        there = x - d
        inside = (there >= 0) & (there < len(x))
        there = there.clamp(0, len(x) - 1)
        difference = (left.int() - right[:, there].int()).abs() >> DIFFERENCE_SHIFT
        cost = (bits ^ its_bits[..., there]).sum(0) + difference.clamp(max=MAX_DIFFERENCE)
        costs.append(torch.where(left_valid & right_valid[:, there] & inside, cost, UNSEEN_COST))
    return torch.stack(costs, -1).to(torch.uint8)


def signature(picture: Tensor) -> Tensor:
    """Bits (offset, height, width): True where the neighbour is darker."""
    height, width = picture.shape
    row, column = torch.arange(height, device=picture.device), torch.arange(width, device=picture.device)
    darker = [
        picture[(row + dy).clamp(0, height - 1)][:, (column + dx).clamp(0, width - 1)] < picture for dx, dy in OFFSETS
    ]
    return torch.stack(darker)
