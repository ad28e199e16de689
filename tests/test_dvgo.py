"""DVGO: activation after interpolation, finer grids, the tight box, rates by views, the terms of its loss."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import tiny
import torch
from budgets import budget

from lumigraph.camera.rays import Look, Samples
from lumigraph.commands.cli import main
from lumigraph.components.fields.voxels import VoxelGrid, corners, shape_of, tight_box
from lumigraph.components.training.row_optimizers import LazyAdam
from lumigraph.datasets.scene import Frame
from lumigraph.evaluation import evaluate
from lumigraph.lab.explain.activation import fits
from lumigraph.methods.dvgo import DVGO, FINE_ALPHA, point_error, shift_of
from lumigraph.run import build
from lumigraph.training import fit
from lumigraph.volume import composite, weights_of

pytestmark = budget("methods", 8)

BOX = [[-1.0, -0.5, 0.0], [1.0, 0.5, 0.25]]
OPEN = Frame(reach=4.0, near=0.1, image_count=4)


def method(frame: Frame, **options) -> DVGO:
    return build(DVGO, frame, replace(DVGO.smallest(), **options), torch.device("cpu"), 0)


@pytest.mark.parametrize("alpha", [1e-6, 1e-2, 0.5])
def test_an_empty_voxel_stops_the_share_of_light_that_it_should(alpha):
    b = torch.tensor(shift_of(alpha), dtype=torch.float64)
    assert float(-torch.expm1(-torch.nn.functional.softplus(b))) == pytest.approx(alpha, rel=1e-9)


def test_a_sharp_edge_needs_activation_after_interpolation():
    pre, within, post = fits(cells=8, steps=30)
    assert post.psnr > max(pre.psnr, within.psnr) + 2


def test_the_edge_is_drawn(tmp_path):
    picture = tmp_path / "edge.png"
    assert main(["explain", "activation", "--output", str(picture), "--steps", "2", "--cells", "3"]) == 0
    assert picture.stat().st_size > 1000


def test_voxels_are_cubes():
    assert shape_of([2.0, 1.0, 0.25], 32_000) == (81, 41, 11)
    assert VoxelGrid(BOX, 32_000, 1).edge == pytest.approx(0.025)


def test_a_finer_grid_in_a_tighter_box_blends_as_the_coarse_one_did(generator):
    grid = VoxelGrid(BOX, 500, 2)
    plane = torch.tensor([[1.0, -2.0], [3.0, 0.5], [-1.0, 4.0]])
    grid.values.data = corners(grid.box, grid.shape) @ plane
    old, optimizer = grid.values, LazyAdam([grid.values])
    tighter = torch.tensor([[-0.5, -0.25, 0.1], [0.75, 0.25, 0.2]])
    grid.rebuild(tighter, 3000, optimizer)
    points = tighter[0] + torch.rand(50, 3, generator=generator) * (tighter[1] - tighter[0])
    torch.testing.assert_close(grid(points), points @ plane, atol=1e-5, rtol=1e-5)
    assert optimizer.param_groups[0]["params"][0] is grid.values is not old
    assert len(grid.values) == math.prod(grid.shape) > len(old)


def test_the_tight_box_has_a_voxel_around_what_is_inside():
    inside = torch.zeros(9, 5, 3, dtype=torch.bool)
    box = torch.tensor(BOX)
    torch.testing.assert_close(tight_box(box, inside), box)
    inside[3:5, 2, 0] = True
    torch.testing.assert_close(tight_box(box, inside), torch.tensor([[-0.5, -0.25, 0.0], [0.25, 0.25, 0.125]]))


def test_what_was_dense_stays_as_dense_and_the_rest_begins_anew():
    made = method(Frame())
    grid = made.network.density_grid
    places = corners(grid.box, grid.shape)
    grid.values.data[(places.abs() < 0.45).all(-1)] = 20.0
    middle, outside = torch.zeros(1, 3), torch.full((1, 3), 0.55)
    before = made.density(middle)
    made._advance(1)
    torch.testing.assert_close(made.density(middle), before, rtol=1e-4, atol=0.0)
    assert float(grid.box.abs().max()) < 0.7
    free = -math.log1p(-FINE_ALPHA) / float(made.network.edge)
    assert made.density(outside).item() >= 0.99 * free
    assert made._stage_at(0.0) == 0 and made._stage_at(1.0) == 1 + made.config.doublings


def test_contracted_voxels_are_thinner_the_larger_they_are():
    made = method(OPEN)
    near, far = made.density(torch.tensor([[0.3, 0.0, 0.0], [3.0, 0.0, 0.0]]))
    assert near > 3 * far > 0


@pytest.mark.parametrize("frame", [Frame(has_alpha=True), OPEN], ids=["object", "open"])
def test_rates_are_shares_of_the_photographs_that_see_a_voxel(frame):
    scene = tiny.scene()
    made = method(replace(frame, image_count=len(scene.cameras)))
    rates = made._view_share(replace(scene, frame=made.frame))
    assert len(rates) == len(made.network.density_grid.values)
    assert 0 <= float(rates.min()) < float(rates.max()) <= 1


def test_a_row_learns_at_its_own_rate():
    rows = torch.nn.Parameter(torch.ones(3, 2))
    optimizer = LazyAdam([{"params": [rows], "rates": torch.tensor([1.0, 0.5, 0.0])}], lr=0.1)
    rows.square().sum().backward()
    optimizer.step()
    torch.testing.assert_close(rows.detach(), torch.tensor([[0.9] * 2, [0.95] * 2, [1.0] * 2]))


def test_each_sample_answers_for_its_own_colour(generator):
    samples = Samples.rows(torch.tensor([[1.0, 1.5], [2.0, 2.25]]), torch.tensor([2.0, 3.0]))
    density, rgb = torch.rand(4, generator=generator), torch.rand(4, 3, generator=generator)
    target = torch.rand(2, 3, generator=generator)
    off = (rgb - target.repeat_interleave(2, 0)).square().sum(-1)
    wanted = (weights_of(samples, density) * off).sum() / 2
    torch.testing.assert_close(point_error(Look("samples", samples, density, rgb), target), wanted)


def test_each_stage_has_weights_of_its_own():
    scene = tiny.scene()
    made = method(scene.frame, coarse_point_weight=0.4, point_weight=0.1, coarse_entropy_weight=0.3, entropy_weight=0.1)
    batch = made.batch(scene, torch.Generator().manual_seed(0))
    for stage, points, entropy in (0, 0.4, 0.3), (1, 0.1, 0.1):
        made.network.stage.fill_(stage)
        terms = made.loss(batch, 0)
        (samples,), _ = made.learn(batch.rays, made.random(0))
        look = samples.look(made.network)
        torch.testing.assert_close(terms["points"], points * point_error(look, batch.before(made.background)))
        opacity = composite(look.samples, look.density, look.rgb).opacity.clamp(1e-6, 1 - 1e-6)
        chaos = torch.distributions.Bernoulli(opacity).entropy().mean()
        torch.testing.assert_close(terms["entropy"], entropy * chaos, rtol=1e-3, atol=1e-9)


def test_it_learns_held_out_views():
    scene = tiny.scene()
    made = method(scene.frame)
    before = evaluate(made, scene).psnr
    fit(made, scene, None, steps=40, show=False, rehearsal=False)
    assert int(made.network.stage) == 1 + made.config.doublings
    assert evaluate(made, scene).psnr > before + 6
