"""Plenoxels: a grid keeps its values when it grows and is pruned, its optimizer follows, losses are the paper's."""

import math

import pytest
import tiny
import torch

from lumigraph import kernels
from lumigraph.components.training.regularizers import cauchy
from lumigraph.components.training.row_optimizers import LazyRMSprop
from lumigraph.errors import LumigraphError
from lumigraph.kernels import Nodes
from lumigraph.methods.plenoxels import Config, Plenoxels, undecided
from lumigraph.methods.plenoxels.sparse_voxels import SparseVoxels


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def some_voxels(cells=(4, 6, 8)) -> SparseVoxels:
    voxels = SparseVoxels(cells, 0.1)
    with torch.no_grad():
        voxels.density.copy_(random(len(voxels), 1, seed=1))
        voxels.harmonics.copy_(random(len(voxels), 27, seed=2))
    return voxels


def test_a_finer_grid_means_the_same():
    voxels, places = some_voxels(), 2 * random(50, 3) - 1
    directions = torch.nn.functional.normalize(random(50, 3, seed=3) - 0.5, dim=-1)
    before = voxels.at(places, directions)
    voxels.rebuild(torch.ones(2, 2, 2, dtype=torch.bool), (8, 12, 16))
    assert len(voxels) == 9 * 13 * 17
    for old, new in zip(before, voxels.at(places, directions), strict=True):
        torch.testing.assert_close(new, old, atol=1e-5, rtol=1e-4)


def test_pruning_leaves_what_is_kept_and_nothing_else():
    voxels, kept = some_voxels((8, 8, 8)), torch.zeros(8, 8, 8, dtype=torch.bool)
    kept[2:4, 3:5, 5] = True
    inside = (random(20, 3) * torch.tensor([2, 2, 1]) + torch.tensor([2, 3, 5])) / 4 - 1
    outside = torch.tensor([[0.9, 0.9, 0.9], [-0.9, 0.1, 0.3]])
    before = voxels.density_at(inside)
    voxels.rebuild(kept, (8, 8, 8))
    assert len(voxels) == 3 * 3 * 2
    torch.testing.assert_close(voxels.density_at(inside), before)
    assert (voxels.density_at(outside) == 0).all()


def test_samples_that_weigh_keep_the_cells_around_their_node():
    voxels = some_voxels((4, 4, 4))
    assert voxels.important(0.1).all()  # nothing was seen yet
    voxels.note(torch.tensor([[0.05, -0.04, 0.0], [-1.0, -1.0, -1.0]]), torch.tensor([0.5, 0.01]))
    found = voxels.important(0.1)
    expected = torch.zeros(4, 4, 4, dtype=torch.bool)
    expected[1:3, 1:3, 1:3] = True
    assert torch.equal(found, expected)


def test_a_part_teaches_the_rows_that_samples_touch_and_no_other():
    voxels, places = some_voxels(), 2 * random(7, 3) - 1
    directions = torch.nn.functional.normalize(random(7, 3, seed=3) - 0.5, dim=-1)

    def loss(table):
        density, rgb = table.at(places, directions)
        return density.square().sum() + rgb.square().sum()

    whole = torch.autograd.grad(loss(voxels), [voxels.density, voxels.harmonics])
    rows = voxels.touched(places)
    part = torch.autograd.grad(loss(voxels.part(rows)), [voxels.density, voxels.harmonics])
    for dense, sparse in zip(whole, part, strict=True):
        assert sparse.is_sparse and sparse._values().shape[0] == len(rows) < len(voxels)
        torch.testing.assert_close(sparse.to_dense(), dense)


def test_the_optimizer_follows_a_rebuilt_grid():
    voxels = some_voxels()
    optimizer = LazyRMSprop([{"params": [voxels.density]}, {"params": [voxels.harmonics]}])
    voxels.at(torch.zeros(3, 3), torch.eye(3))[0].sum().backward()
    optimizer.step()
    square = optimizer.state[voxels.density]["square"].clone()
    middle = square.argmax()
    number = voxels.numbers[middle]
    x, y, z = (int(i) for i in torch.unravel_index(number, (5, 7, 9)))
    voxels.rebuild(torch.ones(1, 1, 1, dtype=torch.bool), (8, 12, 16), optimizer)
    assert optimizer.param_groups[0]["params"][0] is voxels.density and len(optimizer.state) == 2
    moved = optimizer.state[voxels.density]["square"].view(9, 13, 17)
    torch.testing.assert_close(moved[2 * x, 2 * y, 2 * z], square[middle, 0])


def test_rmsprop_is_the_equation_and_passes_over_other_rows():
    table = torch.nn.Parameter(random(6, 2))
    before, rows = table.detach().clone(), torch.tensor([1, 4])
    optimizer = LazyRMSprop([table], lr=0.1, beta=0.9, eps=1e-8)
    square = torch.zeros(2, 2)
    expected = before.clone()
    for step in range(3):
        optimizer.zero_grad()
        slope = random(2, 2, seed=step) - 0.5
        (torch.nn.functional.embedding(rows, table, sparse=True) * slope).sum().backward()
        optimizer.step()
        square = slope**2 if step == 0 else 0.9 * square + 0.1 * slope**2
        expected[rows] -= 0.1 * slope / (square.sqrt() + 1e-8)
    torch.testing.assert_close(table.detach(), expected)
    assert torch.equal(table.detach()[[0, 2, 3, 5]], before[[0, 2, 3, 5]])


def test_a_slab_varies_at_its_edge_alone():
    """A step of height h between two planes of n^2 nodes: sqrt(h^2 + 1e-9) at each, next to nothing elsewhere."""
    n, height = 6, 0.5
    values = torch.where(torch.arange(n) < 3, 0.0, height)[:, None, None].expand(n, n, n).reshape(-1, 1)
    found = kernels.total_variation(torch.arange(n**3), Nodes.all((n, n, n)), values)
    torch.testing.assert_close(float(found), height / n, atol=1e-4, rtol=1e-3)


def test_losses_are_the_papers():
    density = torch.tensor([0.0, 1.0, 3.0])
    torch.testing.assert_close(float(cauchy(density, 2)), (math.log(3) + math.log(19)) / 2)
    sure, unsure = undecided(torch.tensor([0.0, 1.0])), undecided(torch.tensor([0.5]))
    assert float(sure) < float(unsure) == pytest.approx(2 * math.log(0.5))


def test_the_density_learns_slowly_at_first():
    method = Plenoxels(tiny.scene().frame, Plenoxels.smallest())
    early, late = method.learning_rate(0, 0.0), method.learning_rate(0, method.config.density_delay)
    share = method.config.base_resolution / 256
    assert early["density"] == pytest.approx(0.01 * share * method.config.density_learning_rate)
    assert late["density"] > 50 * early["density"] and late["harmonics"] < early["harmonics"]


def test_a_grid_that_begins_too_fine_is_refused():
    with pytest.raises(LumigraphError, match="--base-resolution 64 is above --max-resolution 32"):
        Config(base_resolution=64, max_resolution=32).check()
