"""3-D photographs: a square before a wall, from three places, as a layered panorama, a mesh and a page."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from budgets import budget
from test_dense_start import ball

from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.commands.cli import main
from lumigraph.depth_maps import DepthMap
from lumigraph.errors import LumigraphError
from lumigraph.export import photo3d as room
from lumigraph.export.options import Photo3DOptions
from lumigraph.export.photo3d import layers, stitching
from lumigraph.geometry import evenly

pytestmark = budget("exports", 6)

WALL, SQUARE, SIDE = 4.0, 2.0, 0.4  # distances along the axis; half of the square's side
RED, GREEN = torch.tensor([0.8, 0.2, 0.1]), torch.tensor([0.1, 0.7, 0.2])


def seen_from(x: float) -> DepthMap:
    """A red square before a green wall, from a place on the x axis."""
    width, height, focal = 90, 60, 80.0
    pose = torch.eye(3, 4)
    pose[0, 3] = x
    lens = Pinhole(torch.full((1, 2), focal), torch.tensor([[width / 2, height / 2]]))
    camera = Camera(pose[None], lens, torch.tensor([[width, height]]))
    directions = camera.rays(camera.pixels()).directions
    on_square = SQUARE * directions[:, :2] / directions[:, 2:] + pose[:2, 3]
    square = (on_square.abs() < SIDE).all(-1)
    z = torch.where(square, SQUARE, WALL)
    rgb = torch.where(square[:, None], RED, GREEN).view(height, width, 3)
    return DepthMap.measured(camera, (z / directions[:, 2]).view(height, width), rgb)


def layered():
    maps = [seen_from(x) for x in (-0.3, 0.0, 0.3)]
    panorama = room.panorama_camera(maps)
    each = [stitching.drawn(seen, 1 / seen.depth, torch.ones(3), panorama) for seen in maps]
    front, label = stitching.stitched(each, panorama)
    return panorama, each, front, label


def test_unknown_depth_ends_at_edges_of_colour():
    """Around the square's outline depth is unknown, and found again from both sides."""
    seen = seen_from(0.0)
    near = seen.depth < 3
    rim = torch.nn.functional.max_pool2d(near.float()[None], 7, 1, 3)[0] - near.float() > 0
    gappy = DepthMap.measured(seen.camera, torch.where(rim, torch.nan, seen.depth), seen.rgb)
    error = (stitching.dense_inverse_depth(gappy) * seen.depth - 1).abs()
    assert error.max() < 0.15 and error.mean() < 0.01


def test_the_first_layer_is_what_the_middle_sees():
    panorama, _, front, _ = layered()
    rays = panorama.rays(panorama.pixels())
    z = (front.depth.reshape(-1) * rays.directions[:, 2])[front.known.reshape(-1)]
    assert (((z - WALL).abs() < 0.05) | ((z - SQUARE).abs() < 0.05)).float().mean() > 0.97
    square = (front.depth < 3) & front.known
    torch.testing.assert_close(front.rgb[square].median(0).values, RED, atol=0.02, rtol=0)


def test_the_second_layer_is_the_wall_behind_the_square():
    panorama, each, front, _ = layered()
    back = layers.background(front, each)
    behind = back.known & (front.depth < 3)
    z = (back.depth.reshape(-1) * panorama.rays(panorama.pixels()).directions[:, 2]).view(back.depth.shape)[behind]
    assert behind.any() and ((z - WALL).abs() < 0.2).float().mean() > 0.95
    torch.testing.assert_close(back.rgb[behind].median(0).values, GREEN, atol=0.02, rtol=0)
    assert (back.depth >= front.depth)[back.known].all()


def test_no_triangle_joins_square_and_wall():
    panorama, each, front, _ = layered()
    vertices, faces, uv = layers.mesh_of(front, None, panorama)
    z = vertices[faces][..., 2]
    assert len(faces) and (z.max(1) < 1.2 * z.min(1)).all()
    assert uv.min() >= 0 and uv.max() <= 1


def test_pyramids_fill_with_what_is_around():
    known = torch.rand(30, 41, generator=torch.Generator().manual_seed(0)) > 0.7
    ramp = torch.arange(41.0).expand(30, 41)[..., None]
    assert (layers.push_pull(ramp, known) - ramp).abs().mean() < 1
    torch.testing.assert_close(layers.push_pull(torch.full_like(ramp, 3.0), known), torch.full_like(ramp, 3.0))


@pytest.fixture
def given_depth(monkeypatch):
    """Photographs of the ball with depth maps of three places of their own."""
    places = [-0.3, 0.0, 0.3]
    monkeypatch.setattr(room, "depth_of", lambda scene, numbers, size: [seen_from(x) for x in places])
    monkeypatch.setattr(room, "texture_of", lambda front, back, *_: layers.np.zeros((8, 8, 3), np.uint8))
    return places


def test_a_burst_from_one_place_becomes_a_panorama(given_depth):
    assert not room.photo3d(ball(), Photo3DOptions(90, 3)).flat
    given_depth[:] = [0.0, 0.001, 0.002]
    assert room.photo3d(ball(), Photo3DOptions(90, 3)).flat


def test_a_photograph_without_any_depth_is_named(given_depth, monkeypatch):
    maps = [seen_from(x) for x in given_depth]
    maps[1] = DepthMap.measured(maps[1].camera, torch.full_like(maps[1].depth, torch.nan), maps[1].rgb)
    monkeypatch.setattr(room, "depth_of", lambda *_: maps)
    scene = ball()
    name = scene.names[evenly(scene.splits["train"].tolist(), 3)[1]]
    with pytest.raises(LumigraphError, match=f"{name} shares too little with the others"):
        room.photo3d(scene, Photo3DOptions(90, 3))


def test_a_page_holds_the_picture_and_the_reach(given_depth, tmp_path):
    found = room.photo3d(ball(), Photo3DOptions(90, 3))
    assert found.reach == pytest.approx(0.3, abs=1e-3)
    room.write_page(tmp_path / "photo.html", found, "A square")
    page = (tmp_path / "photo.html").read_text()
    assert '"picture":' in page and "A square" in page and len(page) < 10e6


def test_one_photograph_is_a_fault():
    scene = ball()
    alone = replace(scene, splits={"train": torch.arange(1), "test": torch.arange(0)})
    with pytest.raises(LumigraphError, match="has one photograph"):
        room.photo3d(alone, Photo3DOptions(90))


def test_photographs_without_poses_are_captured_first(tmp_path, monkeypatch, ball_folder, capsys):
    (bare := tmp_path / "burst").mkdir()
    for picture in sorted(ball_folder.rglob("*.png"))[:3]:
        (bare / picture.name).write_bytes(picture.read_bytes())

    def refused(photographs, *_):
        raise LumigraphError(f"no features in {photographs[0]}")

    monkeypatch.setattr("lumigraph.commands.capture.find_cameras", refused)
    monkeypatch.chdir(tmp_path)
    assert main(["photo3d", str(bare), str(tmp_path / "photo.html")]) == 2
    assert f"no features in {bare}" in capsys.readouterr().err


def test_an_ending_that_is_neither_page_nor_mesh_is_a_fault(ball_folder, tmp_path, capsys):
    assert main(["photo3d", str(ball_folder), str(tmp_path / "photo.png")]) == 2
    assert "ends in .html or .glb" in capsys.readouterr().err
