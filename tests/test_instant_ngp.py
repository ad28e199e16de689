"""Instant-NGP, small: it learns, repeats itself to the bit, and its options and edge cases do what they say."""

from __future__ import annotations

from dataclasses import replace

import pytest
import tiny
import torch
from budgets import budget

from lumigraph.camera.rays import Rays
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.scene import Scene
from lumigraph.evaluation import held_out_poses
from lumigraph.evaluation.views import evaluate
from lumigraph.files.ranges import changed
from lumigraph.methods import instant_ngp
from lumigraph.methods.instant_ngp import Config, InstantNGP
from lumigraph.run import Run, build
from lumigraph.training import fit

pytestmark = budget("methods", 15)

SMALL = changed(
    Config(),
    levels=4,
    log2_hashmap_size=11,
    base_resolution=4,
    max_resolution=32,
    hidden_width=16,
    sh_bands=2,
    samples_per_step=2048,
    steps_per_diagonal=128,
    occupancy_resolution=32,
)


def method(scene: Scene, seed: int = 0, **options) -> InstantNGP:
    return build(InstantNGP, scene.frame, changed(SMALL, **options), torch.device("cpu"), seed)


def black_room(reach: float = 1.0) -> Scene:
    """The ball before black, as photographs without alpha show it."""
    scene = tiny.scene()
    images = ImageStore.from_arrays([tiny.picture(pose)[..., :3] for pose in scene.cameras.pose])
    frame = replace(scene.frame, reach=reach, has_alpha=False, background=(0.0, 0.0, 0.0))
    return replace(scene, images=images, frame=frame)


def train(made: InstantNGP, scene: Scene, steps: int, run: Run | None = None, **options):
    return fit(made, scene, run, steps=steps, show=False, rehearsal=False, **options)


def test_it_learns_held_out_views():
    scene = tiny.scene()
    made = method(scene)
    before = evaluate(made, scene).psnr
    train(made, scene, 100)
    assert evaluate(made, scene).psnr > before + 6  # dB; about 9 at first


def test_gradients_reach_everything_that_learns():
    scene = tiny.scene()
    made = method(scene, exposure_correction="yes", refine_cameras=True)
    made.optimizers()
    made.before_step(0, 0.0)
    sum(made.loss(made.batch(scene, torch.Generator().manual_seed(0)), 0).values()).backward()
    for name, parameter in made.named_parameters():
        assert parameter.grad.abs().sum() > 0, name
    touched = (made.network.table.grad != 0).float().mean()
    assert 0.01 < touched <= 1


def test_each_ray_stands_before_a_colour_and_its_opposite(monkeypatch):
    scene, losses = tiny.scene(), []
    made = method(scene)
    made.before_step(0, 0.0)
    batch = made.batch(scene, torch.Generator().manual_seed(0))
    for level in (0.2, 0.8, 0.5):  # of the background; rays are not jittered

        def drawn(*shape, generator, level=level):
            return torch.full(shape, level if len(shape) > 1 else 0.0)

        monkeypatch.setattr(torch, "rand", drawn)
        losses.append(made.loss(batch, 0)["huber"].item())
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)
    assert abs(losses[0] - losses[2]) > 1e-3 * losses[2]


@pytest.mark.parametrize("scene", [tiny.scene, black_room], ids=["alpha", "no alpha"])
def test_the_same_seed_gives_the_same_losses(scene, tmp_path):
    losses = []
    for i, seed in enumerate((0, 0, 1)):
        made = method(scene(), seed)
        run = Run.create(tmp_path / str(i), made, scene())
        train(made, scene(), 8, run, seed=seed, log_every=1)
        losses.append([row["loss"] for row in run.metrics()])
    assert len(losses[0]) == 8 and losses[0] == losses[1]
    assert all(a != b for a, b in zip(losses[0], losses[2], strict=True))


@pytest.mark.parametrize(
    "options", [{}, {"exposure_correction": "yes", "refine_cameras": True}], ids=["plain", "corrections"]
)
def test_resuming_equals_never_having_stopped_to_the_bit(options, tmp_path):
    scene, ends = tiny.scene(), []
    for name, pauses in (("straight", [None]), ("broken", [10, None])):
        Run.create(tmp_path / name, method(scene, **options), scene)
        for pause_at in pauses:
            run = Run(tmp_path / name)
            made = run.new_method()
            train(made, scene, 20, run, pause_at=pause_at, log_every=1)
        assert run.state.step == 20
        ends.append((made.state_dict(), [row["loss"] for row in run.metrics()]))
    (expected, losses), (actual, again) = ends
    assert losses == again and len(losses) == 20
    assert expected.keys() == actual.keys()
    for name, value in expected.items():
        assert torch.equal(value, actual[name]), name
    restored = Run(tmp_path / "straight").method().state_dict()  # the grid is finer than a fresh method's
    assert all(torch.equal(value, restored[name]) for name, value in expected.items())


def test_exposure_finds_the_dark_photographs(monkeypatch):
    monkeypatch.setattr(instant_ngp, "DECAY_START", 0.9)
    scene = black_room()
    dark = scene.splits["train"][::2]
    pictures = [tiny.picture(pose)[..., :3] // (4 if i in dark else 1) for i, pose in enumerate(scene.cameras.pose)]
    scene = replace(scene, images=ImageStore.from_arrays(pictures))
    made = method(scene, exposure_correction="yes")
    train(made, scene, 120)
    gain = made.exposure.log_gain.detach()
    bright = scene.splits["train"][1::2]
    assert gain[dark].mean() < gain[bright].mean() - 0.01
    assert (gain[scene.splits["test"]] == 0).all()


def test_refining_cameras_moves_those_that_were_trained_on(monkeypatch):
    monkeypatch.setattr(held_out_poses, "STEPS", 5)  # for each photograph; 200 otherwise
    scene = tiny.scene()
    made = method(scene, refine_cameras=True)
    before = evaluate(made, scene).psnr
    train(made, scene, 50)
    twist = made.poses.twist.detach()
    assert (twist[scene.splits["train"]] != 0).any(-1).all() and (twist[scene.splits["test"]] == 0).all()
    assert twist.abs().max() < 0.1 and evaluate(made, scene).psnr > before + 2


def test_an_unbounded_scene_trains_and_renders():
    scene = black_room(reach=4.0)
    made = method(scene)
    before = evaluate(made, scene).psnr
    train(made, scene, 60)
    assert made.sampler.is_open and made.sampler.proposal.grid.values.grad is not None
    seen = made.render(scene.cameras[0])
    assert torch.isfinite(seen.rgb).all() and torch.isfinite(seen.opacity).all() and not seen.depth.isnan().any()
    assert seen.opacity.max() > 0.5 and evaluate(made, scene).psnr > before + 2


def away(count: int = 3) -> Rays:
    """Rays that begin outside the scene and leave it."""
    directions = torch.eye(3)[:count]
    return Rays(3 + directions, directions, torch.full((count,), 0.01))


@pytest.mark.parametrize("reach", [1.0, 2.0])
def test_a_ray_that_meets_nothing_shows_the_background(reach):
    made = method(black_room(reach), contraction=False)
    behind = torch.tensor([[0.2, 0.4, 0.6]])
    for context in (torch.no_grad, torch.enable_grad):
        with context():
            seen = made.render_rays(away(), behind)
        assert torch.equal(seen.rgb.detach(), behind.expand(3, 3))
        assert (seen.opacity == 0).all() and (seen.depth == torch.inf).all()


@pytest.mark.parametrize("reach", [1.0, 4.0])
def test_an_empty_grid_renders_and_trains(reach):
    scene = black_room(reach)
    scene = replace(scene, frame=replace(scene.frame, background=(0.2, 0.4, 0.6)))
    made = method(scene, contraction=False)
    made.sampler.grid.rule_out(torch.zeros_like(made.sampler.grid.possible))
    seen = made.render(scene.cameras[0])
    assert seen.rgb.shape == (tiny.SIZE, tiny.SIZE, 3)
    torch.testing.assert_close(seen.rgb[3, 5], torch.tensor([0.2, 0.4, 0.6]))
    assert (seen.opacity == 0).all() and (seen.depth == torch.inf).all()
    before = made.network.table.detach().clone()
    assert train(made, scene, 3).finished
    assert torch.equal(made.network.table, before)


def test_photographs_with_alpha_carve_the_grid():
    scene = tiny.scene()
    made = method(scene)
    made.begin(scene)
    grid = made.sampler.grid
    assert grid.resolution == SMALL.occupancy.occupancy_resolution and 0.02 < grid.share < 0.5
    unbounded = method(black_room(4.0), contraction=False)
    unbounded.begin(black_room(4.0))
    assert unbounded.sampler.grid.share == 1 and len(unbounded.sampler.grid.density) == 3


def test_batches_grow_to_the_wanted_number_of_samples():
    scene = tiny.scene()
    made = method(scene)
    train(made, scene, 60)
    assert 0.6 < made.statistics()["samples"] / SMALL.occupancy.samples_per_step < 1.6
    assert made.statistics()["visible_samples"] <= made.statistics()["samples"]


def test_the_preset_of_a_cpu_is_smaller_than_the_papers():
    cpu, gpu = (InstantNGP.preset(torch.device(name)) for name in ("cpu", "cuda"))
    assert gpu == Config()
    assert (gpu.table.levels, gpu.table.features_per_level, gpu.table.log2_hashmap_size) == (16, 2, 19)
    assert cpu.occupancy.samples_per_step < gpu.occupancy.samples_per_step
    assert cpu.table.max_resolution < gpu.table.max_resolution
