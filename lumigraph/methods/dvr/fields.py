"""Fields of DVR: a logit of occupancy and a raw colour at points, from one network or from a hash table."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ... import kernels
from ...components.fields.hash_field import Joining, TableNumbers, new_table
from ...components.fields.layers import MLP, ResNetLayers
from ...components.training.row_optimizers import LazyAdam

EXTENT = 1.1  # half-size of the cube that the hash table covers: differences beyond the box of interest stay inside
LOGIT_SCALE = 50.0  # logits per scene unit at the surface of the first sphere

Outputs = Float[Tensor, "point 4"]  # logit of occupancy, raw colour


class OccupancyField(nn.Module):
    """f and t in one network: residual blocks with ReLU (Niemeyer 2020, section 4.1; the release's decoder.py)."""

    def __init__(self, width: int, blocks: int):
        super().__init__()
        self.first, self.last = nn.Linear(3, width), nn.Linear(width, 4)
        self.blocks = nn.Sequential(*(ResNetLayers(width, width) for _ in range(blocks)))

    def begin_as(self, centre: Float[Tensor, " 3"], radius: float) -> None:
        """Nothing: the network is initialised at random."""

    def forward(self, points: Float[Tensor, "point 3"]) -> Outputs:
        return self.last(self.blocks(self.first(points)).relu())

    def optimizers_at(self, learning_rate: float) -> list[torch.optim.Optimizer]:
        return [torch.optim.Adam(self.parameters(), learning_rate, foreach=True)]


class TableField(nn.Module):
    """The same from a hash table and a small network, beside the logit of a sphere that it begins as.

    joining: weights of the levels, which join from coarse to fine; None where all count fully
    """

    centre: Tensor
    radius: Tensor

    def __init__(self, numbers: TableNumbers, width: int, joining: Joining | None):
        super().__init__()
        self.levels, self.joining = numbers.levels_of(), joining
        self.table, self.network = new_table(self.levels), MLP(numbers.width, width, width, 4)
        self.register_buffer("centre", torch.zeros(3))
        self.register_buffer("radius", torch.tensor(0.5))

    def begin_as(self, centre: Float[Tensor, " 3"], radius: float) -> None:
        """Set the initial sphere, before the first step."""
        self.centre.copy_(centre)
        self.radius.fill_(radius)

    def forward(self, points: Float[Tensor, "point 3"]) -> Outputs:
        encoded = kernels.hash_encode((points * (0.5 / EXTENT) + 0.5).clamp(0, 1), self.table, self.levels)
        weights = self.joining(self.levels.levels) if self.joining else None
        if weights is not None:
            encoded = encoded * weights.repeat_interleave(self.levels.features)
        logit, raw = self.network(encoded).split([1, 3], -1)
        sphere = self.radius - (points - self.centre).norm(dim=-1, keepdim=True)
        return torch.cat([LOGIT_SCALE * sphere + logit, raw], -1)

    def optimizers_at(self, learning_rate: float) -> list[torch.optim.Optimizer]:
        table = LazyAdam([self.table], learning_rate, betas=(0.9, 0.99), eps=1e-15)
        return [table, torch.optim.Adam(self.network.parameters(), learning_rate, (0.9, 0.99), 1e-15)]
