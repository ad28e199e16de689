"""Points of shapes with signed distance and occupancy, sampled once for each shape, mostly close to its surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from ...datasets.shapes import PointBatch, Shape, Shapes
from ...errors import LumigraphError
from ...files.ranges import NonNegative, Seed, Share, between

MEMBER_SEEDS = 1_000_003  # from the seed of one member's points to that of the next


@dataclass(frozen=True)
class PointNumbers:
    """A Config's numbers of sampled points. Those that are not close to the surface are uniform in [-1, 1]^3."""

    pool_points: Annotated[int, between(64, 1 << 26)] = 500_000  # points sampled of each shape; more cost memory
    near_share: Share = 0.94  # share of the points close to the surface; more sharpen it, and leave space unsure
    near_spread: NonNegative = 0.05  # deviation of half of these from the surface, scene units; larger: smoother
    fine_spread: NonNegative = 0.0158  # deviation of the other half, scene units; smaller gives finer detail


class PointPools:
    """Pools of points of each training member, sampled on first use.

    learner: the method's name, for faults
    """

    def __init__(self, learner: str, numbers: PointNumbers, seed: Seed):
        self.learner, self.numbers, self.seed = learner, numbers, seed
        self.pools: dict[int, PointBatch] = {}

    def draw(
        self, shapes: Shapes, member: int, count: int, generator: torch.Generator, balanced: bool = False
    ) -> PointBatch:
        """Random points of a member's pool; `balanced`: half of them inside. Raises LumigraphError for a member without
        an inside."""
        if member not in self.pools:
            own = torch.Generator().manual_seed(self.seed + MEMBER_SEEDS * (member + 1))
            self.pools[member] = sampled(shapes.members[member], self.numbers, self.learner, own, member)
        pool = self.pools[member]
        if not balanced:
            return pool[torch.randint(len(pool), (count,), generator=generator)]
        assert isinstance(pool.occupancy, Tensor)
        sides = [side.nonzero()[:, 0] for side in (pool.occupancy > 0, pool.occupancy == 0) if side.any()]
        rows = [side[torch.randint(len(side), (-(-count // len(sides)),), generator=generator)] for side in sides]
        return pool[torch.cat(rows)[:count]]

    def lesson(
        self, shapes: Shapes, members: int, count: int, generator: torch.Generator, balanced: bool = False
    ) -> PointBatch:
        """Points of random training members, `count` of each, member after member; `balanced` as in `draw`."""
        there = shapes.splits["train"]
        drawn = there[torch.randint(len(there), (members,), generator=generator)].tolist()
        return PointBatch.cat([self.draw(shapes, number, count, generator, balanced) for number in drawn])


def sampled(
    shape: Shape, numbers: PointNumbers, learner: str, generator: torch.Generator, member: int = 0
) -> PointBatch:
    """Points of a shape with their distance and occupancy (Park 2019, section 5 and its supplement). Raises
    LumigraphError for a shape without an inside."""
    if shape.is_cloud:
        raise LumigraphError(
            f"{learner} learns which points are inside of a shape, and {shape.name} has points and no faces; "
            "name a mesh, or complete the cloud with a trained prior: lumigraph infer"
        )
    near = round(numbers.near_share * numbers.pool_points)
    spreads = torch.where(torch.arange(near) % 2 == 0, numbers.near_spread, numbers.fine_spread)
    around = shape.surface(near, generator).points + spreads[:, None] * torch.randn(near, 3, generator=generator)
    evenly = 2 * torch.rand(numbers.pool_points - near, 3, generator=generator) - 1
    found = shape.known(torch.cat([around, evenly]), member)
    assert isinstance(found.occupancy, Tensor)
    if not found.occupancy.any():
        raise LumigraphError(
            f"{learner} learns which points are inside of a shape, and {shape.name} encloses none; close its surface, "
            "or turn its faces outwards"
        )
    return found
