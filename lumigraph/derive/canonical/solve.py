"""Rotations that bring instances of a category to stand alike: the network's, then those onto the mean shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ...geometry import evenly
from .grids import Instance
from .learning import Config, found_rotations, learn
from .mean_shape import best_alignment, best_rotations, described
from .network import Canonicaliser


@dataclass(frozen=True)
class Solution:
    """rotations: of each instance into the canonical frame
    predicted: what the network alone says, in a frame of its own
    agreement: of each instance with the mean shape, 1 for the same
    explained: share of all instances' squared moments that the mean shape has
    """

    rotations: Float[Tensor, "some 3 3"]
    predicted: Float[Tensor, "some 3 3"]
    agreement: Float[Tensor, " some"]
    explained: float
    network: Canonicaliser


def solve(instances: Sequence[Instance], config: Config) -> Solution:
    """Learn what the instances share, and turn each onto it.

    The mean shape is found from several beginnings: what the network says, and each of a few instances taken for it;
    the one that explains most of all instances is kept.
    """
    network = learn(instances, config)
    predicted = found_rotations(network, instances)
    shapes = described(instances)
    some = evenly(range(len(instances)), config.templates)
    found = best_alignment(shapes, [predicted, *(best_rotations(shapes[i], shapes) for i in some)])
    return Solution(found.rotations, predicted, found.agreement, found.explained, network)
