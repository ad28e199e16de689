"""Pictures of many cameras at once: threads change nothing, depth is in metres, a spinning sensor gives ranges."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from budgets import budget

import lumigraph
from lumigraph.camera import Camera, ring
from lumigraph.camera.lens import EnhancedUnified, FieldOfView, Fisheye
from lumigraph.errors import LumigraphError
from lumigraph.exchange import write_gaussians
from lumigraph.export import cameras as many
from lumigraph.gaussians import Gaussians
from lumigraph.opening import open_scene

pytestmark = budget("runs", 5)
RADIUS = 3.0  # metres, of a hollow sphere of Gaussians around the origin


@pytest.fixture(scope="module")
def shell(tmp_path_factory) -> Path:
    """A sphere of opaque, thin Gaussians, seen from inside: every ray from its centre is RADIUS long."""
    count = 20_000
    k = torch.arange(count)
    z, turn = 1 - 2 * (k + 0.5) / count, math.pi * (3 - math.sqrt(5)) * k
    level = (1 - z * z).sqrt()
    out = torch.stack([level * turn.cos(), level * turn.sin(), z], -1)
    half = torch.nn.functional.normalize(out + torch.tensor([0.0, 0.0, 1.0 + 1e-4]), dim=-1)
    quaternions = torch.stack([half[:, 2], -half[:, 1], half[:, 0], torch.zeros(count)], -1)
    scales = torch.tensor([0.05, 0.05, 0.005]).expand(count, 3).log()
    file = tmp_path_factory.mktemp("shell") / "shell.ply"
    colours = (0.5 * (out + 1) - 0.5)[:, None] / 0.28209479177387814
    write_gaussians(file, Gaussians(RADIUS * out, quaternions, scales, torch.full((count,), 4.0), colours))
    return file


def looking_out(count: int) -> torch.Tensor:
    """Poses at the origin."""
    poses = ring(((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), count=count).pose.clone()
    poses[:, :, 3] = 0
    return poses


def test_threads_and_batches_give_the_pictures_of_single_cameras(shell, monkeypatch):
    run, poses = lumigraph.open(shell, metres=1.0), looking_out(5)
    cameras = run.placed(Camera.pinhole(poses, (40, 30), 60.0))
    alone = [run.opened.render(cameras[i]) for i in range(5)]
    names = set()
    picture = many.picture_of
    monkeypatch.setattr(many, "processors", lambda: 2)
    monkeypatch.setattr(many, "picture_of", lambda *x: (names.add(many.numba.get_num_threads()), picture(*x))[1])
    batch = run.render(cameras)
    assert names == {1}, "each thread computes alone"
    assert (batch.rgb == torch.stack([one.rgb for one in alone])).all() and batch.depth.shape == (5, 30, 40)
    assert torch.get_num_threads() >= 1 and many.numba.get_num_threads() == many.numba.config.NUMBA_NUM_THREADS
    sizes = run.render([cameras[0], run.placed(Camera.pinhole(poses[:2], (24, 16), 60.0))])
    assert [tuple(one.depth.shape) for one in sizes] == [(30, 40), (16, 24), (16, 24)]
    first = next(iter(run.rendered(cameras)))  # a generator that is left early ends its threads
    assert (first.rgb == alone[0].rgb).all()


def test_depth_is_in_metres_where_a_length_is_known(shell):
    run = lumigraph.open(shell)
    assert run.depth_unit.startswith("units of the photographs' frame") and "metres=" in run.depth_unit
    for metres in (1.0, 0.5, 2.5):
        known = lumigraph.open(shell, metres=metres)
        seen = known.render(known.placed(Camera.pinhole(looking_out(3), (32, 24), 50.0)))
        assert known.depth_unit == "metres" and seen.opacity.min() > 0.9
        assert (seen.depth / (metres * RADIUS) - 1).abs().median() < 0.015
    with pytest.raises(LumigraphError, match="is no length"):
        lumigraph.open(shell, metres=-1.0)


def test_a_spinning_sensor_gives_ranges(shell):
    """Also off centre: |p + t d| = RADIUS for each ray."""
    run = lumigraph.open(shell, metres=1.0)
    pose = looking_out(2)[1:]
    pose[:, :, 3] = torch.tensor([0.5, 0.8, -0.3])
    sensor = Camera.spinning(pose, beams=16, columns=180, low=-15.0, high=15.0)
    seen = run.render(run.placed(sensor))
    assert seen.depth.shape == (16, 180)
    rays = sensor.rays(sensor.pixels())
    assert rays.directions[0] @ pose[0, :, 1] < 0, "the first row looks up"
    along = (rays.origins * rays.directions).sum(-1)
    exact = -along + (along**2 - rays.origins.square().sum(-1) + RADIUS**2).sqrt()
    assert (seen.depth.flatten() / exact - 1).abs().median() < 0.015
    elevation = torch.rad2deg(torch.asin(-(rays.directions @ pose[0, :, 1])))
    assert elevation.max().item() == pytest.approx(15 - 15 / 16, abs=1e-3)


@pytest.mark.parametrize(
    ("lens", "least"),
    [
        (Fisheye(torch.full((1, 2), 13.0), torch.full((1, 2), 24.0), torch.zeros(1, 4)), 1.75),  # past 90 degrees
        (FieldOfView(torch.full((1, 2), 30.0), torch.full((1, 2), 24.0), torch.tensor([[0.9]])), 0.6),
        (EnhancedUnified(*torch.full((2, 1, 2), 20.0), *torch.tensor([[[0.6]], [[1.1]]])), 0.6),
    ],
)
def test_clouds_are_seen_through_lenses_without_a_flat_picture(lens, least, shell):
    """Off centre, as above: colours and ranges are those of the wall along each ray."""
    run = lumigraph.open(shell, metres=1.0)
    pose = looking_out(1)
    pose[:, :, 3] = torch.tensor([0.4, 0.2, -0.3])
    camera = Camera(pose, lens, torch.tensor([[48, 48]]))
    seen = run.render(run.placed(camera))
    rays = camera.rays(camera.pixels())
    assert float((rays.directions @ pose[0, :, 2]).min().acos()) > least
    along = (rays.origins * rays.directions).sum(-1)
    exact = -along + (along**2 - rays.origins.square().sum(-1) + RADIUS**2).sqrt()
    assert (seen.depth.flatten() / exact - 1).abs().median() < 0.015 and seen.opacity.min() > 0.9


def test_readers_of_depth_cameras_know_the_metre():
    assert open_scene("procedural:room,depth,views=2,size=16").frame.in_metres
    assert not open_scene("procedural:room,depth,views=2,size=16,scale=3").frame.in_metres
    assert not open_scene("procedural:still-life,views=2,size=16").frame.in_metres
