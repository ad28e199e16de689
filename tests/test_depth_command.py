"""`lumigraph depth`: what it writes opens as a scene whose layer of depth is the true one."""

from __future__ import annotations

import pytest
import torch
from budgets import budget
from PIL import Image
from test_dense_start import RADIUS, ball
from test_multi_view import matched

from lumigraph.commands.cli import main
from lumigraph.errors import LumigraphError
from lumigraph.export.depth import write_depth
from lumigraph.opening import open_scene

pytestmark = budget("exports", 6)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("depth") / "ball"
    write_depth(path, ball(), matched())
    return path


def test_the_folder_opens_as_a_scene_with_depth(folder):
    """Pixels with depth lie on the ball, in the capture's frame."""
    scene = open_scene(folder)
    assert len(scene) == len(matched())
    off, count = [], 0
    for i, given in enumerate(matched()):
        photograph = scene.photograph(i, ["depth"])
        depth = photograph.extra["depth"]
        assert torch.equal(depth.isfinite(), given.solid)
        rays = photograph.camera.rays(photograph.camera.pixels()[depth.isfinite().flatten()])
        places = rays.at(depth[depth.isfinite()])
        off.append((scene.frame.to_source.points(places).norm(dim=-1) - RADIUS).abs())
        count += len(places)
    assert count > 100
    assert torch.cat(off).median() < 0.03


def test_depth_survives_sixteen_bits(folder):
    scene = open_scene(folder)
    for i, given in enumerate(matched()):
        depth = scene.photograph(i, ["depth"]).extra["depth"] * scene.frame.to_source.scale
        torch.testing.assert_close(depth[given.solid], given.depth[given.solid], rtol=1e-4, atol=1e-4)


def test_the_contact_sheet_shows_every_photograph(folder):
    with Image.open(folder / "depth.png") as sheet:
        assert sheet.width > 200 and sheet.height > 200


def test_photographs_that_agree_on_nothing_are_a_fault(tmp_path):
    nothing = [type(m)(m.camera, torch.full_like(m.depth, torch.nan), 0 * m.opacity, m.rgb) for m in matched()]
    with pytest.raises(LumigraphError, match="agree on the depth"):
        write_depth(tmp_path / "none", ball(), nothing)
    assert not (tmp_path / "none").exists()


def test_the_command_says_the_share_of_each_photograph(tmp_path, capsys):
    output = tmp_path / "d"
    command = f"depth procedural:still-life,size=50 --output {output} --views 5 --size 50"
    assert main(command.split()) == 0
    said = capsys.readouterr().out
    assert "sure pixels" in said and said.count("train_") == 5
    assert len([*(output / "depth").glob("*.png")]) == 5
