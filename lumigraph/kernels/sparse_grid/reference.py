"""Reference implementation: trilinear interpolation of eight nodes."""

import itertools

import torch
from torch import Tensor

from . import Nodes


def run(points: Tensor, nodes: Nodes, values: Tensor) -> Tensor:
    cells = torch.tensor(nodes.index.shape, device=points.device) - 1
    place = points.clamp(0, 1) * cells
    cell = torch.minimum(place.detach().long(), cells - 1)
    fraction = place - cell
    total = values.new_zeros(len(points), values.shape[1])
    for corner in itertools.product((0, 1), repeat=3):
        side = torch.tensor(corner, device=points.device)
        weight = torch.where(side == 1, fraction, 1 - fraction).prod(-1)
        total = total + weight[:, None] * _at(cell + side, nodes, values)
    return total


def _at(place: Tensor, nodes: Nodes, values: Tensor) -> Tensor:
    """Values of nodes, 0 where one has no row."""
    row = nodes.index[place[:, 0], place[:, 1], place[:, 2]]
    row = torch.where(row >= 0, torch.cat([nodes.named, nodes.rows.new_full((1,), -1)])[row.long()], -1)
    return torch.cat([values, values.new_zeros(1, values.shape[1])])[row.long()]
