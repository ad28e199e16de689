"""Warped table: a hash field under a warp that depends on time, sampled by proposals. For tests of fields."""

from dataclasses import dataclass

import torch

from lumigraph.components.fields.hash_field import TINY_TABLE, HashField, HashNumbers
from lumigraph.components.fields.layers import MLP
from lumigraph.components.fields.spaces import contraction_of
from lumigraph.components.sampling.samplers import ProposalNumbers, ProposalSampler
from lumigraph.files.ranges import LearningRate, Seed
from lumigraph.method import Field, FieldMethod


@dataclass(frozen=True)
class Config:
    table: HashNumbers = HashNumbers()
    proposals: ProposalNumbers = ProposalNumbers()
    learning_rate: LearningRate = 1e-2
    seed: Seed = 0


class Warped(Field):
    """A field at points that a network moves; the code is the moment."""

    deforms = True

    def __init__(self, field):
        super().__init__()
        self.field, self.offset = field, MLP(4, 16, 3)

    def geometry(self, points, code=None):
        code = points.new_zeros(len(points), 1) if code is None else code
        return self.field.geometry(points + 0.1 * self.offset(torch.cat([points, code], -1)))

    def colour(self, features, directions, code=None):
        return self.field.colour(features, directions)


class WarpedTable(FieldMethod):
    Config = Config

    def __init__(self, frame, config):
        super().__init__(frame, config)
        space = contraction_of(frame)
        self.network = Warped(HashField(config.table, 16, space, frame.reach))
        self.sampler = ProposalSampler(space, config.proposals, samples_per_step=2048)

    @classmethod
    def smallest(cls):
        return Config(TINY_TABLE, learning_rate=2e-2)

    def code(self, rays):
        return self.moments(rays)[:, None]

    def optimizers(self):
        rate, warp = self.config.learning_rate, self.network.offset.parameters()
        return [*self.network.field.optimizers_at(rate), torch.optim.Adam(warp, rate), *super().optimizers()]
