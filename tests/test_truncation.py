"""Truncated factors: nothing is lost where nothing goes, and what goes is the least that can."""

from __future__ import annotations

import pytest
import torch

from lumigraph.methods.tensorf.factorised import FactorGrid, decomposed, truncate


def seen(grid: FactorGrid, summed: bool) -> torch.Tensor:
    points = torch.rand(400, 3, generator=torch.Generator().manual_seed(1))
    return grid(points, summed=summed).detach()


@pytest.mark.parametrize("kind", ["vm", "cp"])
def test_without_a_share_a_sum_stays(kind):
    torch.manual_seed(0)
    grid = FactorGrid(kind, (12, 9, 7), 6)
    before = seen(grid, True)
    truncate(grid, 0.0)
    assert torch.allclose(seen(grid, True), before, atol=1e-6)


def test_more_components_than_nodes_become_as_many_as_nodes():
    torch.manual_seed(0)
    grid = FactorGrid("vm", (4, 5, 3), 16)
    before = seen(grid, True)
    truncate(grid, 0.0)
    assert torch.allclose(seen(grid, True), before, atol=1e-6)
    assert (grid.table == 0).all(0).sum() == 16 - 5  # no line has more nodes


def test_a_product_loses_its_smallest_singular_values():
    plane, line = torch.randn(30, 8), torch.randn(11, 8)
    one, other = decomposed(plane, line)
    whole, values = plane @ line.T, torch.linalg.svdvals(plane @ line.T)
    assert torch.allclose(one @ other.T, whole, atol=1e-4)
    for kept in (1, 4, 7):
        error = (one[:, :kept] @ other[:, :kept].T - whole).square().sum()
        assert error == pytest.approx(float(values[kept:].square().sum()), rel=1e-3, abs=1e-4)


def test_components_that_count_for_little_go_first():
    torch.manual_seed(0)
    grid = FactorGrid("vm", (12, 9, 7), 5)
    weights = torch.ones(3, 5)
    weights[1, 2] = weights[2, 4] = 1e-3
    before = seen(grid, False).view(-1, 3, 5)
    truncate(grid, 0.01, weights)
    after = seen(grid, False).view(-1, 3, 5)
    gone = (after == 0).all(0)
    assert gone.nonzero().tolist() == [[1, 2], [2, 4]]
    assert torch.equal(after[:, ~gone], before[:, ~gone])
