"""Two fields: the union of two hash fields in one sampler. For tests of fields that are composed."""

from dataclasses import dataclass

from lumigraph.components.fields.hash_field import HashField, HashNumbers
from lumigraph.components.fields.spaces import space_of
from lumigraph.components.sampling.occupancy_sampler import OccupancyNumbers, StepNumbers
from lumigraph.components.sampling.samplers import TINY_HASH, ProposalNumbers, sampler_for
from lumigraph.files.ranges import LearningRate, Seed
from lumigraph.method import Field, FieldMethod


@dataclass(frozen=True)
class Config:
    table: HashNumbers = HashNumbers()
    occupancy: OccupancyNumbers = OccupancyNumbers()
    steps: StepNumbers = StepNumbers()
    learning_rate: LearningRate = 1e-2
    seed: Seed = 0


class Union(Field):
    """Densities add up; each field's colour counts by its share of the density."""

    def __init__(self, first, second):
        super().__init__()
        self.first, self.second = first, second

    def geometry(self, points, code=None):
        (one, first), (other, second) = self.first.geometry(points), self.second.geometry(points)
        return one + other, (first, second, (one / (one + other).clamp_min(1e-9))[:, None])

    def colour(self, features, directions, code=None):
        first, second, share = features
        return share * self.first.colour(first, directions) + (1 - share) * self.second.colour(second, directions)


class TwoFields(FieldMethod):
    Config = Config

    def __init__(self, frame, config):
        super().__init__(frame, config)
        space = space_of(frame)
        self.network = Union(*(HashField(config.table, 16, space, frame.reach) for _ in range(2)))
        self.sampler = sampler_for(frame, space, config.occupancy, ProposalNumbers(), steps=config.steps)

    @classmethod
    def smallest(cls):
        return Config(**TINY_HASH, learning_rate=2e-2)

    def optimizers(self):
        fields, rate = (self.network.first, self.network.second), self.config.learning_rate
        return [x for field in fields for x in field.optimizers_at(rate)] + super().optimizers()
