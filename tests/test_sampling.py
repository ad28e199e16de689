"""Where rays are looked at: evenly, then like what was found; and where there is no need."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch

from lumigraph.components.sampling.cone_sampler import blurred, frustum_moments
from lumigraph.components.sampling.occupancy import OccupancyMask
from lumigraph.components.sampling.sampling import inverse_of, inverse_transform, stratified


def test_one_in_each_bin(generator):
    shares = stratified(500, 8, generator)
    assert torch.equal((shares * 8).floor(), torch.arange(8.0).expand(500, 8))
    torch.testing.assert_close(shares.mean(0), stratified(1, 8)[0], rtol=0, atol=0.01)
    assert shares.std(0).min() > 0.9 / 8 / 12**0.5


def test_samples_spread_like_the_weights(generator):
    """Their distribution function is the weights' own, up to the step between two samples."""
    edges = torch.tensor([[0.0, 0.1, 0.5, 0.6, 2.0]])
    weights = torch.tensor([[1.0, 0.0, 5.0, 2.0]])
    found = inverse_transform(edges, weights, stratified(1, 4000, generator))[0]
    assert (found.diff() >= 0).all()
    for x, below in [(0.1, 1 / 8), (0.5, 1 / 8), (0.55, 3.5 / 8), (0.6, 6 / 8), (1.3, 7 / 8)]:
        assert float((found <= x).float().mean()) == pytest.approx(below, abs=2e-3)


def test_where_nothing_was_found_samples_are_even():
    edges = torch.linspace(2, 6, 9)[None]
    found = inverse_transform(edges, torch.zeros(1, 8), stratified(1, 16))
    torch.testing.assert_close(found, 2 + 4 * stratified(1, 16))


def test_the_loop_inverts_as_the_definition_does(generator):
    """Bins of equal and of no weight, shares on their borders, and shares that fall."""
    edges = torch.rand(5, 9, generator=generator).cumsum(-1)
    weights = torch.rand(5, 8, generator=generator)
    weights[1, 2:5], weights[2], weights[3, :7] = 0, 0, 0
    shares = torch.cat([stratified(5, 30, generator), torch.tensor([0.0, 1.0, 0.5, 0.25]).expand(5, 4)], -1)
    expected = inverse_of(*(x.double() for x in (edges, weights, shares)))
    torch.testing.assert_close(inverse_transform(edges, weights, shares).double(), expected, atol=1e-3, rtol=0)


def test_no_sample_leaves_its_bins():
    shares = torch.tensor([[0.0, 1e-9, 0.5, 1 - 1e-7, 1.0]])
    found = inverse_transform(torch.tensor([[1.0, 1.5, 3.0]]), torch.tensor([[0.0, 1e9]]), shares)
    assert found.min() >= 1 and found.max() <= 3 and found.isfinite().all()


def test_blurred_weights_surround_what_was_found():
    weights = torch.tensor([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
    assert blurred(weights).tolist() == [[0.0, 0.5, 1.0, 0.5, 0.0, 0.0]]
    assert blurred(torch.ones(2, 5)).tolist() == [[1.0] * 5] * 2


def cone_points(start: float, end: float, radius: float, generator, count: int = 400_000) -> torch.Tensor:
    """Points filling a conical frustum around the z axis evenly."""
    u = torch.rand(count, generator=generator, dtype=torch.float64)
    t = (start**3 + u * (end**3 - start**3)) ** (1 / 3)
    r = radius * t * torch.rand(count, generator=generator, dtype=torch.float64).sqrt()
    angle = 2 * torch.pi * torch.rand(count, generator=generator, dtype=torch.float64)
    return torch.stack([r * angle.cos(), r * angle.sin(), t], -1)


@pytest.mark.parametrize(
    ("start", "end", "radius"), [(1.0, 1.5, 0.1), (0.0, 1.0, 0.5), (2.0, 2.1, 0.02), (0.1, 4.0, 1.0)]
)
def test_moments_are_those_of_sampled_cones(start, end, radius, generator):
    points = cone_points(start, end, radius, generator)
    mean, along, across = (float(x) for x in frustum_moments(*(torch.tensor([v]) for v in (start, end, radius))))
    assert mean == pytest.approx(float(points[:, 2].mean()), rel=2e-3)
    assert along == pytest.approx(float(points[:, 2].var()), rel=1e-2)
    assert across == pytest.approx(float(points[:, 0].var()), rel=1e-2)


def test_moments_of_thin_frusta_keep_their_digits():
    start = torch.tensor([1.0, 4.0, 100.0])
    end = start * (1 + 1e-3)
    radius = torch.full((3,), 1e-3)
    for thin, wide in zip(
        frustum_moments(start, end, radius), frustum_moments(start.double(), end.double(), radius.double()), strict=True
    ):
        torch.testing.assert_close(thin.double(), wide, rtol=2e-3, atol=0)


def test_a_place_may_hold_what_its_cell_does(generator):
    """Outside the cube the nearest cell answers."""
    empty = OccupancyMask(8, 0.01)
    empty.grid.occupied = torch.rand(1, 8, 8, 8, generator=generator) < 0.5
    points = 3 * torch.rand(2000, 3, generator=generator) - 1.5
    points[0], points[1] = -1.0, 1.0
    for point, held in zip(points, empty.may_hold(points), strict=True):
        x, y, z = (min(max(math.floor((p + 1) * 4), 0), 7) for p in point.tolist())
        assert held == empty.grid.occupied[0, x, y, z]


def test_nothing_near_what_is_there_is_ruled_out(generator):
    """However wide the blur, a place that has something within its radius may hold something."""
    empty = OccupancyMask(32, 0.01)
    there = torch.zeros(1, 32, 32, 32, dtype=torch.bool)
    there[0, 20, 9, 30] = True
    empty.grid.rule_out(there)
    cell = torch.tensor([20.5, 9.5, 30.5]) / 16 - 1
    points = 2 * torch.rand(4000, 3, generator=generator) - 1
    radius = torch.rand(4000, generator=generator) * 0.5
    near = (points - cell).norm(dim=-1) < radius
    found = empty.may_hold(points, radius)
    assert near.any() and found[near].all()
    small = empty.may_hold(points, torch.full((4000,), 1e-3))
    assert small.sum() < 40  # 27 cells of 32 768 hold about 3 of them


def test_a_grid_that_looks_finds_what_is_there():
    empty = OccupancyMask(16, 0.01)

    def ball(x: torch.Tensor) -> torch.Tensor:
        return 10.0 * (x.norm(dim=-1) < 0.5)

    network = SimpleNamespace(density_at=ball)
    method = SimpleNamespace(network=network, random=lambda number: torch.Generator().manual_seed(~number))
    for step in range(0, 1600, 16):
        empty.before_step(method, step, 0.5)
    points = torch.tensor([[0.0, 0, 0], [0.3, 0.2, 0], [0.9, 0.9, 0.9], [-0.8, 0, 0]])
    assert empty.may_hold(points).tolist() == [True, True, False, False]
