"""Volume rendering: which samples are worth asking about."""

from __future__ import annotations

import pytest
import torch

from lumigraph import kernels
from lumigraph.camera.rays import Samples
from lumigraph.volume import FIRST_STRETCH, visible_weights


def packed_samples(lengths):
    starts = torch.tensor([0, *lengths]).cumsum(0)
    t = torch.arange(float(starts[-1]))
    return Samples(t, t + 1, starts)


@pytest.mark.parametrize("stop", [0.0, 1e-3, 0.2])
@pytest.mark.parametrize("lengths", [[], [0, 0], [1], [3, 0, 40, 1, 7, 0, 129]])
def test_visible_samples_are_those_with_weight(lengths, stop, generator):
    samples = packed_samples(lengths)
    tau = torch.rand(len(samples), generator=generator) + 0.01
    asked = []
    found = visible_weights(samples, lambda numbers: asked.append(numbers) or tau[numbers], stop) > 0
    *_, weights = kernels.composite(tau, tau[:, None], samples.ray_starts, stop)
    assert torch.equal(found, weights > 0)
    numbers = torch.cat([torch.zeros(0, dtype=torch.int64), *asked])
    assert len(numbers.unique()) == len(numbers)


def test_a_spent_ray_is_asked_no_further():
    samples = packed_samples([1000, 1000])
    asked = []

    def wall_and_air(numbers):
        asked.append(numbers)
        return torch.where(numbers < 1000, 10.0, 0.0)

    found = visible_weights(samples, wall_and_air, 1e-3) > 0
    numbers = torch.cat(asked)
    assert (numbers < 1000).sum() == FIRST_STRETCH and (numbers >= 1000).sum() == 1000
    assert found.nonzero()[:, 0].tolist() == [0]
