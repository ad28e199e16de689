"""What methods are built from: perceptrons, optimizers, the occupancy grid, carving, corrections."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import pytest
import tiny
import torch

from lumigraph.camera.rays import Rays
from lumigraph.components.fields.layers import MLP, truncated_exp
from lumigraph.components.sampling.occupancy import OccupancyGrid, visual_hull
from lumigraph.components.training.photometric import Exposure
from lumigraph.components.training.pose_refinement import PoseRefinement
from lumigraph.components.training.row_optimizers import LazyAdam, adam_rate
from lumigraph.datasets.images import ImageStore
from lumigraph.run.checkpoint import take_shapes

# MLP


def seeded(generator, *widths) -> MLP:
    network = MLP(*widths)
    for weight in network.weights:
        weight.data = torch.randn(weight.shape, generator=generator) / weight.shape[1] ** 0.5
    return network


def chain(weights, x):
    """The same network, written down."""
    *hidden, last = weights
    for weight in hidden:
        x = torch.relu(x @ weight.t())
    return x @ last.t()


def values_and_gradients(network, x, weights):
    y = network(x)
    mixture = torch.linspace(-1, 1, y.numel()).view(y.shape)
    return [y, *torch.autograd.grad((y * mixture).sum(), [x, *weights])]


@pytest.mark.parametrize("planes", [False, True], ids=["rows", "planes"])
@pytest.mark.parametrize("samples", [0, 1, 16, 41])
@pytest.mark.parametrize("widths", [(5, 3), (6, 8, 4), (6, 16, 16, 3)])
def test_perceptron_is_a_chain_of_layers(widths, samples, planes, generator):
    network = seeded(generator, *widths)
    x = torch.randn(samples, widths[0], generator=generator)
    x = (x.t().contiguous().t() if planes else x).requires_grad_()
    weights = [*network.weights]
    expected = values_and_gradients(lambda x: chain(weights, x), x, weights)
    for found, wanted in zip(values_and_gradients(network, x, weights), expected, strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)


def test_perceptron_whose_input_wants_no_gradient(generator):
    network = seeded(generator, 3, 4, 2)
    network(torch.randn(7, 3, generator=generator)).sum().backward()
    assert all(w.grad.abs().sum() > 0 for w in network.weights)


# Optimizer and activation


def gradients(count, generator, shape=(50, 2)):
    return torch.randn(count, *shape, generator=generator)


def descend(optimizer, p, slopes):
    for slope in slopes:
        p.grad = slope.clone()
        optimizer.step()


@pytest.mark.parametrize("decay", [0.0, 0.5])
def test_lazy_adam_is_adam_where_every_gradient_counts(decay, generator):
    begin, slopes = torch.randn(50, 2, generator=generator), gradients(20, generator)
    results = []
    for kind in (LazyAdam, torch.optim.AdamW):
        p = torch.nn.Parameter(begin.clone())
        descend(kind([p], lr=0.02, betas=(0.9, 0.99), eps=1e-15, weight_decay=decay), p, slopes)
        results.append(p.detach())
    assert (results[0] - begin).abs().mean() > 0.02
    torch.testing.assert_close(results[0], results[1], rtol=1e-5, atol=1e-6)


def test_lazy_adam_leaves_alone_what_has_no_gradient(generator):
    p = torch.nn.Parameter(torch.randn(50, 2, generator=generator))
    optimizer = LazyAdam([p], weight_decay=0.5)
    descend(optimizer, p, gradients(3, generator))
    held = [x.detach().clone() for x in (p, optimizer.state[p]["mean"], optimizer.state[p]["square"])]
    slopes = gradients(4, generator)
    slopes[:, ::3] = 0
    descend(optimizer, p, slopes)
    for now, before in zip((p, optimizer.state[p]["mean"], optimizer.state[p]["square"]), held, strict=True):
        assert torch.equal(now[::3], before[::3])
        assert (now[1::3] != before[1::3]).all()


@pytest.mark.parametrize("by_row", [False, True])
def test_lazy_adam_moves_the_same_on_a_gpu(by_row, generator):
    gpu = pytest.importorskip("lumigraph.components.training.row_optimizers_gpu", exc_type=ImportError)
    start, device = torch.randn(900, 4, generator=generator), "cuda" if torch.cuda.is_available() else "cpu"
    p, rates = torch.nn.Parameter(start.clone()), torch.rand(900, generator=generator).round(decimals=1)
    optimizer = LazyAdam([p], weight_decay=0.1)
    (group,) = optimizer.param_groups
    group["rates"] = rates if by_row else None
    theirs = [x.to(device) for x in (start.clone(), *torch.zeros(2, 900, 4))]
    for t in range(1, 6):
        p.grad = torch.randn(900, 4, generator=generator) * (torch.rand(900, 4, generator=generator) < 0.5)
        descend(optimizer, p, p.grad[None])
        numbers = adam_rate(group, t), *group["betas"], group["eps"], 1 - group["lr"] * group["weight_decay"]
        gpu.lazy_adam(theirs[0], p.grad.to(device), *theirs[1:], rates.to(device) if by_row else None, *numbers)
    for a, b in zip((p.detach(), *(optimizer.state[p][name] for name in ("mean", "square"))), theirs, strict=True):
        torch.testing.assert_close(a, b.cpu(), rtol=1e-4, atol=1e-6)


def test_lazy_adam_goes_on_from_a_saved_state(generator):
    begin, slopes = torch.randn(50, 2, generator=generator), gradients(6, generator)
    straight, broken = (torch.nn.Parameter(begin.clone()) for _ in range(2))
    descend(LazyAdam([straight]), straight, slopes)
    first = LazyAdam([broken])
    descend(first, broken, slopes[:3])
    second = LazyAdam([broken])
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    descend(second, broken, slopes[3:])
    assert torch.equal(straight, broken)


def test_lazy_adam_skips_parameters_without_a_gradient():
    p = torch.nn.Parameter(torch.ones(3))
    LazyAdam([p]).step()
    assert torch.equal(p.detach(), torch.ones(3))


def test_truncated_exp_has_a_slope_no_steeper_than_its_limit():
    x = torch.tensor([-20.0, 0.0, 3.0, 14.9, 20.0, 1000.0], requires_grad=True)
    y = truncated_exp(x)
    torch.testing.assert_close(y[:5], x[:5].exp())
    assert torch.isfinite(y).all()
    (slope,) = torch.autograd.grad(y.sum(), x)
    torch.testing.assert_close(slope, x.clamp(max=15).exp())


# Occupancy


def ball(radius: float, density: float = 10.0):
    return lambda points: density * (points.norm(dim=-1) < radius).float()


def nearest_and_farthest(n: int):
    """Distances from the origin to each cell of a grid over [-1, 1]^3: to its nearest point and to its farthest."""
    low = torch.arange(n) * (2 / n) - 1
    high = low + 2 / n
    nearest = torch.where((low < 0) & (high > 0), 0, torch.minimum(low.abs(), high.abs()))
    farthest = torch.maximum(low.abs(), high.abs())
    return (torch.stack(torch.meshgrid(x, x, x, indexing="ij")).norm(dim=0) for x in (nearest, farthest))


def ball_grid(generator, radius=0.5, n=16) -> OccupancyGrid:
    grid = OccupancyGrid(1.0, n)
    for _ in range(4):
        grid.update(ball(radius), 1.0, generator)
    return grid


def test_occupancy_finds_a_ball(generator):
    grid = ball_grid(generator)
    nearest, farthest = nearest_and_farthest(16)
    assert grid.occupied[0][farthest < 0.5].all() and not grid.occupied[0][nearest > 0.5].any()
    assert (farthest < 0.5).sum() > 100 and grid.share == grid.occupied.float().mean()


def test_occupancy_forgets_what_has_gone(generator):
    grid = ball_grid(generator)
    for _ in range(80):
        grid.update(ball(0.2), 1.0, generator, decay=0.9)
    nearest, _ = nearest_and_farthest(16)
    assert grid.occupied.any() and not grid.occupied[0][nearest > 0.2].any()


def test_looking_at_a_share_of_cells_still_sees_what_appears(generator):
    grid = ball_grid(generator, radius=0.3)
    looked_at = []

    def larger(points):
        looked_at.append(len(points))
        return ball(0.6)(points)

    for _ in range(60):
        grid.update(larger, 1.0, generator, share=0.1)
    _, farthest = nearest_and_farthest(16)
    assert grid.occupied[0][farthest < 0.6].float().mean() > 0.97
    assert max(looked_at) < 16**3 / 2


def test_a_budget_of_looks_is_kept_and_everything_gets_its_turn(generator):
    grid, looked_at = ball_grid(generator, radius=0.3), []

    def larger(points):
        looked_at.append(len(points))
        return ball(0.6)(points)

    for _ in range(600):
        grid.update(larger, 1.0, generator, share=0.5, budget=100)
    _, farthest = nearest_and_farthest(16)
    assert max(looked_at) <= 100 and grid.occupied[0][farthest < 0.6].float().mean() > 0.97


def test_a_larger_cell_is_occupied_by_thinner_matter(generator):
    """The same thickness across a cell: half the density where cells are twice as large."""
    grid = OccupancyGrid(2.0, 8)
    grid.update(lambda points: torch.where(points[:, 0] < 0, 3.0, 50.0), 1.0, generator)
    assert not grid.occupied[0, :4].any() and grid.occupied[0, 4:].all()
    assert grid.occupied[1].all()


def test_refining_keeps_what_was_known(generator):
    grid = ball_grid(generator)
    coarse = [getattr(grid, name).clone() for name in grid.grows]
    box = grid.box.clone()
    grid.refine()
    assert grid.resolution == 32
    half = torch.arange(32) // 2
    for name, parent in zip(grid.grows, coarse, strict=True):
        assert torch.equal(getattr(grid, name), parent[:, half][:, :, half][:, :, :, half])
    assert torch.equal(grid.box, box)
    grid.update(ball(0.5), 1.0, generator)
    assert torch.equal(grid.box, box)


@pytest.mark.parametrize("share", [1.0, 0.2])
def test_what_is_ruled_out_stays_empty(share, generator):
    possible = torch.zeros(1, 8, 8, 8, dtype=torch.bool)
    possible[0, 2:5, :, 1:] = True
    grid = OccupancyGrid(1.0, 4)
    grid.rule_out(possible)
    assert torch.equal(grid.occupied, possible) and grid.resolution == 8
    for _ in range(3):
        grid.update(lambda points: torch.ones(len(points)), 0.5, generator, share=share)
    assert not grid.occupied[~possible].any()
    assert torch.equal(grid.occupied, possible) or share < 1
    torch.testing.assert_close(grid.box, torch.tensor([[-0.5, -1, -0.75], [0.25, 1, 1]]))


def test_the_box_is_tight(generator):
    grid = ball_grid(generator, radius=0.4)
    cells = grid.occupied[0].nonzero()
    torch.testing.assert_close(grid.box[0], cells.amin(0) / 8 - 1)
    torch.testing.assert_close(grid.box[1], (cells.amax(0) + 1) / 8 - 1)
    wide = OccupancyGrid(4.0, 8)
    possible = torch.zeros(3, 8, 8, 8, dtype=torch.bool)
    possible[0, 3, 4, 5] = possible[2, 7, 1, 4] = True
    wide.rule_out(possible)
    torch.testing.assert_close(wide.box, torch.tensor([[-0.25, -3, 0], [4, 0.25, 1]]))


def some_rays(generator, count=60) -> Rays:
    origins = 2 * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    targets = torch.rand(count, 3, generator=generator) - 0.5
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    return Rays(origins, directions, torch.full((count,), 0.01))


def occupied_at(grid: OccupancyGrid, points: torch.Tensor) -> torch.Tensor:
    """Whether points lie in occupied cells of a grid of one cascade."""
    n = grid.resolution
    cell = ((points + 1) * n / 2).floor().long()
    x, y, z = cell.clamp(0, n - 1).unbind(-1)
    return ((cell >= 0) & (cell < n)).all(-1) & grid.occupied[0, x, y, z]


def test_samples_are_all_of_a_lattice_that_lies_in_occupied_cells(generator):
    grid, rays, near, step = ball_grid(generator), some_rays(generator), 0.1, 0.04
    samples = grid.sample(rays, near, step)
    points, _ = samples.along(rays)
    assert len(samples) > 500 and occupied_at(grid, points).all()
    k = (samples.t_start - near) / step
    torch.testing.assert_close(k, k.round(), rtol=0, atol=1e-3)
    t = near + (torch.arange(100) + 0.5) * step
    everywhere = rays.origins[:, None] + t[:, None] * rays.directions[:, None]
    missed = occupied_at(grid, everywhere).sum(-1) - samples.ray_starts.diff()
    assert missed.abs().sum() <= 2  # but for midpoints within rounding of a cell's border


def test_jitter_moves_the_lattice(generator):
    grid, rays = ball_grid(generator), some_rays(generator)
    jitter = torch.rand(len(rays), generator=generator)
    samples = grid.sample(rays, 0.1, 0.04, jitter=jitter)
    k = (samples.t_start - 0.1) / 0.04 - jitter[samples.ray_index]
    torch.testing.assert_close(k, k.round(), rtol=0, atol=2e-3)
    assert occupied_at(grid, samples.along(rays)[0]).all()


@pytest.mark.parametrize("growth", [0.0, 1 / 64])
def test_an_empty_grid_gives_no_samples(growth, generator):
    grid, rays = OccupancyGrid(2.0, 4), some_rays(generator)
    assert len(grid.sample(rays, 0.1, 0.04, growth))
    grid.update(lambda points: torch.zeros(len(points)), 1.0, generator)
    assert not grid.occupied.any() and grid.share == 0
    assert grid.sample(rays, 0.1, 0.04, growth, jitter=torch.rand(len(rays))).ray_starts.eq(0).all()


def test_a_fine_grid_loads_into_a_fresh_coarse_one(generator):
    grid = ball_grid(generator)
    grid.refine()
    fresh = OccupancyGrid(1.0, 4)
    take_shapes(fresh, grid.state_dict())
    fresh.load_state_dict(grid.state_dict())
    assert fresh.resolution == 32
    for name, value in grid.state_dict().items():
        assert torch.equal(getattr(fresh, name), value) and getattr(fresh, name) is not value


# Carving


def hull_of_ball(scene):
    hull = visual_hull(scene, 64)
    nearest, _ = nearest_and_farthest(64)
    assert hull.shape == (64, 64, 64)
    assert hull[nearest < 0.6].all(), f"{int((~hull[nearest < 0.6]).sum())} cells of the ball were carved away"
    return float(hull[nearest > 0.7].float().mean())


def test_the_hull_holds_the_ball_and_little_else(monkeypatch):
    monkeypatch.setattr(tiny, "SIZE", 96)
    monkeypatch.setattr(tiny, "FOCAL", 128.0)
    assert hull_of_ball(tiny.scene()) < 0.06


def test_the_hull_holds_what_wide_lenses_see_near_their_corners(monkeypatch):
    """There a cell covers more pixels than in the middle."""
    monkeypatch.setattr(tiny, "SIZE", 64)
    monkeypatch.setattr(tiny, "FOCAL", 20.0)
    monkeypatch.setattr(tiny, "DISTANCE", 2.5)
    scene = tiny.scene()
    aside = torch.nn.functional.normalize(torch.tensor([0.55, 0.55, 1.0]), dim=0)  # where the ball is to be seen
    right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), aside), dim=0)
    turn = torch.stack([right, torch.linalg.cross(aside, right), aside], -1)
    pose = torch.cat([scene.cameras.pose[:, :, :3] @ turn.mT, scene.cameras.pose[:, :, 3:]], -1)
    images = ImageStore.from_arrays([tiny.picture(p) for p in pose])
    assert hull_of_ball(replace(scene, cameras=replace(scene.cameras, pose=pose), images=images)) < 0.3


def test_cameras_that_see_no_part_of_a_cell_do_not_carve_it():
    scene = tiny.scene()
    pose = scene.cameras.pose.clone()
    pose[:, :, [0, 2]] *= -1  # looking away
    images = ImageStore.from_arrays([0 * tiny.picture(p) for p in pose])
    assert visual_hull(replace(scene, cameras=replace(scene.cameras, pose=pose), images=images), 32).all()


# Corrections


def test_exposure_is_a_gain_of_each_photograph():
    exposure, rgb = Exposure(4), torch.rand(6, 3)
    index = torch.tensor([0, 2, 2, 0, 2, 0])
    assert torch.equal(exposure(rgb, index), rgb)
    exposure.log_gain.data[2] = torch.tensor([0.0, math.log(2), -math.log(2)])
    torch.testing.assert_close(exposure(rgb, index)[1], rgb[1] * torch.tensor([1.0, 2.0, 0.5]))
    exposure(rgb, index).sum().backward()
    assert (exposure.log_gain.grad[[0, 2]] != 0).all() and (exposure.log_gain.grad[[1, 3]] == 0).all()


def test_pose_refinement_turns_and_shifts(generator):
    rays = replace(some_rays(generator, 3), image_index=torch.tensor([0, 1, 0]))
    poses = PoseRefinement(2)
    still = poses(rays)
    assert torch.equal(still.origins, rays.origins)
    torch.testing.assert_close(still.directions, rays.directions, rtol=0, atol=1e-7)
    angle, axis = 0.6, torch.tensor([2.0, -1.0, 2.0]) / 3
    poses.twist.data[1] = torch.cat([angle * axis, torch.tensor([0.1, 0.0, -0.2])])
    moved = poses(rays)
    torch.testing.assert_close(moved.origins[1], rays.origins[1] + torch.tensor([0.1, 0.0, -0.2]))
    skew = torch.linalg.cross(axis.expand(3, 3), torch.eye(3)).t()
    torch.testing.assert_close(moved.directions[1], torch.matrix_exp(angle * skew) @ rays.directions[1])
    torch.testing.assert_close(moved.directions[::2], rays.directions[::2])
    torch.testing.assert_close(moved.directions.norm(dim=-1), torch.ones(3))


@pytest.mark.parametrize("size", [0.0, 1e-8, 1e-3, 1.0])
def test_pose_refinement_has_gradients_at_every_angle(size, generator):
    """As the slope of the matrix exponential, in float64."""
    rays = replace(some_rays(generator, 5), image_index=torch.zeros(5, dtype=torch.int64))
    poses = PoseRefinement(1)
    poses.twist.data[0, :3] = size * torch.tensor([0.6, 0.0, -0.8])
    weights = torch.randn(5, 3, generator=generator)
    (found,) = torch.autograd.grad((poses(rays).directions * weights).sum(), poses.twist)
    omega = poses.twist.detach()[0, :3].double().requires_grad_()
    skew = torch.linalg.cross(omega.expand(3, 3), torch.eye(3, dtype=torch.float64)).t()
    turned = rays.directions.double() @ torch.matrix_exp(skew).t()
    (expected,) = torch.autograd.grad((turned * weights).sum(), omega)
    torch.testing.assert_close(found[0, :3].double(), expected, rtol=1e-3, atol=1e-3)


def test_rays_of_no_photograph_are_not_corrected(generator):
    rays = some_rays(generator, 3)
    assert PoseRefinement(2)(rays) is rays
