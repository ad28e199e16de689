"""Fewer photographs to learn from: spread evenly, nested, and the same again after a resume."""

from __future__ import annotations

from dataclasses import replace

import pytest
import tiny
import torch
from budgets import budget

from lumigraph.commands.cli import main
from lumigraph.errors import LumigraphError
from lumigraph.opening import open_scene
from lumigraph.readers.views import spread_out, with_fewer_views
from lumigraph.run import Run

pytestmark = budget("runs", 8)


def kept(scene, views: int) -> set[int]:
    return set(with_fewer_views(scene, views).splits["train"].tolist())


def test_fewer_are_among_more():
    scene = tiny.scene()
    sets = [kept(scene, views) for views in range(1, 10)]
    assert [len(one) for one in sets] == list(range(1, 10))
    assert all(fewer < more for fewer, more in zip(sets, sets[1:], strict=False))
    assert sets[-1] == set(scene.splits["train"].tolist())


def test_each_next_camera_is_the_farthest_from_those_before():
    """Cameras on a circle that look at its middle: the distance is a chord, so the largest gap is halved each time."""
    pose = tiny.poses(16)
    circle = torch.arange(16) * (2 * torch.pi / 16)
    out = torch.stack([circle.cos(), circle.sin(), 0 * circle], -1)
    pose[:, :, 2], pose[:, :, 3] = -out, 3 * out
    camera = tiny.scene(16).cameras
    order = spread_out(type(camera)(pose, camera.lens, camera.size)).tolist()
    assert sorted(order) == list(range(16))
    for count, gap in ((2, 8), (4, 4), (8, 2)):
        assert min((i - j) % 16 for i in order[:count] for j in order[:count] if i != j) == gap


def test_the_first_camera_is_the_one_nearest_the_middle():
    """A rig on a straight rail, all looking one way."""
    pose = tiny.poses(7)[:1].repeat(7, 1, 1)
    pose[:, 0, 3] = torch.tensor([0.0, 1.0, 2.0, 3.5, 4.0, 5.0, 6.0])
    camera = tiny.scene(7).cameras
    assert spread_out(type(camera)(pose, camera.lens, camera.size))[:3].tolist() == [3, 0, 6]


def test_cameras_at_one_place_are_told_apart_by_where_they_look():
    pose = tiny.poses(8)
    pose[:, :, 3] = 0
    camera = tiny.scene(8).cameras
    order = spread_out(type(camera)(pose, camera.lens, camera.size)).tolist()
    assert sorted(order) == list(range(8))


@pytest.mark.parametrize("views", [0, -1, 10])
def test_numbers_that_cannot_be_are_refused(views):
    with pytest.raises(LumigraphError, match="from 1 to 9"):
        with_fewer_views(tiny.scene(), views)


def test_what_is_compared_stays_the_same(tmp_path):
    folder = tiny.write_blender(tmp_path / "ball")
    all_views, three = open_scene(folder), open_scene(folder, views=3)
    assert three.frame == replace(all_views.frame, train_count=3)
    assert torch.equal(three.splits["test"], all_views.splits["test"])
    assert len(three) == len(all_views)


def test_a_run_remembers_its_views(tmp_path):
    folder, output = tiny.write_blender(tmp_path / "ball"), tmp_path / "run"
    arguments = ["train", "voxel-grid", str(folder), "--output", str(output), "--views", "3"]
    assert main([*arguments, "--steps", "4", "--pause-at", "2"]) == 0
    run = Run(output)
    chosen = open_scene(folder, views=3).splits["train"]
    assert run.settings.splits["train"] == 3
    assert torch.equal(run.scene().splits["train"], chosen)
    assert torch.equal(run.cameras()["train"].image_index, chosen)
    assert main(["resume", str(output)]) == 0
    assert run.state.step == 4
