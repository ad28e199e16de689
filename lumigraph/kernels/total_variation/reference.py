"""Reference implementation: differences along three axes."""

import torch
from torch import Tensor

from ..sparse_grid import Nodes
from . import EPSILON


def run(chosen: Tensor, nodes: Nodes, values: Tensor) -> Tensor:
    rows = torch.where(
        nodes.index >= 0, torch.cat([nodes.named, nodes.rows.new_full((1,), -1)])[nodes.index.long()], -1
    )
    place = torch.stack(torch.unravel_index(chosen, rows.shape), -1)
    here = rows[tuple(place.T)]
    square = values.new_full((len(chosen), values.shape[1]), EPSILON)
    for axis, size in enumerate(rows.shape):
        after = place.clone()
        after[:, axis] = (after[:, axis] + 1).clamp(max=size - 1)  # from the last node to itself
        there = rows[tuple(after.T)]
        known = ((here >= 0) & (there >= 0))[:, None]
        difference = _at(there, values) - _at(here, values)
        square = square + torch.where(known, difference, 0).square()
    lengths = torch.where((here >= 0)[:, None], square.sqrt(), 0)
    return lengths.sum() / max(len(chosen), 1)


def _at(row: Tensor, values: Tensor) -> Tensor:
    return torch.cat([values, values.new_zeros(1, values.shape[1])])[row.long()]
