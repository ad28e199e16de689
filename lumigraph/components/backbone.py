"""The backbone of a method: its paper's coordinate network, or a hash table that learns in minutes, and its sampler."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch

from ..datasets.scene import Frame
from ..files.ranges import LearningRate, Width, between
from ..method import Sampler
from .fields.coordinate_field import CoordinateField, NetworkNumbers
from .fields.hash_field import HashField, HashNumbers
from .fields.spaces import Space
from .sampling.occupancy_sampler import OccupancyNumbers, StepNumbers
from .sampling.samplers import CPU_HASH, TINY_HASH, ProposalNumbers, sampler_for

# Numbers of a Config by name, for `changed`: a hash table for a plain CPU, and one for tests.
CPU_BACKBONE: dict[str, Any] = {**CPU_HASH, "field": "hash", "hidden_width": 32}
CPU_BACKBONE |= {"learning_rate": 2e-2, "final_learning_rate": 1e-3, "decay_start": 0.3}
TINY_BACKBONE: dict[str, Any] = {**TINY_HASH, "field": "hash", "hidden_width": 16}
TINY_BACKBONE |= {"learning_rate": 2e-2, "final_learning_rate": 1e-3}


@dataclass(frozen=True)
class BackboneNumbers:
    """A Config's numbers of its field, of the samples in a hash table, and of their learning rate."""

    network: NetworkNumbers = NetworkNumbers()
    table: HashNumbers = HashNumbers()
    occupancy: OccupancyNumbers = OccupancyNumbers()
    steps: StepNumbers = StepNumbers()
    proposals: ProposalNumbers = ProposalNumbers()
    field: Literal["hash", "network"] = "network"  # the paper's networks, or hash tables, which learn in minutes
    hidden_width: Width = 256  # channels of a layer; wider holds more detail, and costs time
    learning_rate: LearningRate = 5e-4  # Adam's learning rate at first; higher: faster, may diverge
    final_learning_rate: LearningRate = 5e-5  # learning rate at the end of the budget, reached exponentially
    decay_start: Annotated[float, between(0, 0.99)] = 0.0  # share of the budget before the learning rate falls

    @property
    def hashed(self) -> bool:
        """True for a hash table."""
        return self.field == "hash"

    def build(
        self,
        frame: Frame,
        space: Space,
        table: Callable[..., Any] = HashField,
        network: Callable[..., Any] = CoordinateField,
        **common: Any,
    ) -> Any:
        """A field over a space. table, network: the kind of each; common: further arguments of either"""
        if self.hashed:
            return table(self.table, self.hidden_width, space, frame.reach, **common)
        return network(self.network, self.hidden_width, space, **common)

    def sampler(self, frame: Frame, space: Space) -> Sampler:
        """Sampler of a hash table: an occupancy grid, or proposals in a scene without bounds."""
        return sampler_for(frame, space, self.occupancy, self.proposals, steps=self.steps)

    def scale(self, of_table: float) -> float:
        """Share of the learning rate of a group beside the field: that of a table, or 1 beside a network."""
        return of_table if self.hashed else 1.0

    def optimizers(
        self, *fields: Any, groups: Iterable[dict[str, Any]] = (), eps: float = 1e-8, **of_table: Any
    ) -> list[torch.optim.Optimizer]:
        """Adam for fields of one kind and further groups of parameters. eps: of networks; of_table: see `HashField`"""
        *others, last = fields
        if self.hashed:
            own = [x for field in others for x in field.optimizers_at(self.learning_rate, **of_table)]
            return [*own, *last.optimizers_at(self.learning_rate, groups=groups, **of_table)]
        every = [p for field in fields for p in field.parameters()] + [p for group in groups for p in group["params"]]
        return [torch.optim.Adam(every, self.learning_rate, eps=eps)]
