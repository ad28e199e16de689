"""One image file as a scene: where the picture hangs, which pixels are held out, and files that are no picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from lumigraph.commands.cli import main
from lumigraph.errors import LumigraphError
from lumigraph.opening import open_scene


def write(path: Path, width: int = 40, height: int = 24, **options) -> Path:
    """Red grows to the right, green downwards."""
    y, x = np.mgrid[:height, :width]
    pixels = np.stack([255 * x / (width - 1), 255 * y / (height - 1), np.full_like(x, 60)], -1)
    Image.fromarray(pixels.astype(np.uint8)).save(path, **options)
    return path


@pytest.mark.parametrize(("width", "height"), [(40, 24), (24, 40), (32, 32)])
def test_the_camera_sees_exactly_the_picture(width, height, tmp_path):
    scene = open_scene(write(tmp_path / "wall.png", width, height))
    rays = scene.cameras[0].rays(torch.tensor([[0.0, 0.0], [width, 0.0], [0.0, height], [width / 2, height / 2]]))
    x, y, z = rays.at(-rays.origins[:, 1] / rays.directions[:, 1]).unbind(1)
    right, top = width / max(width, height), height / max(width, height)
    torch.testing.assert_close(x, torch.tensor([-right, right, -right, 0]))
    torch.testing.assert_close(y, torch.zeros(4))
    torch.testing.assert_close(z, torch.tensor([top, top, -top, 0]))
    (left, _, bottom), corner = scene.frame.bounds
    assert (left, bottom) == pytest.approx((-right, -top)) and corner[::2] == pytest.approx((right, top))


def test_half_of_the_pixels_are_held_out_and_never_drawn(tmp_path, generator):
    scene = open_scene(write(tmp_path / "wall.png"))
    assert {name: len(index) for name, index in scene.splits.items()} == {"train": 1, "test": 1}
    learnt, held_out = (scene.images.mask(int(scene.splits[name][0])) for name in ("train", "test"))
    assert torch.equal(learnt, ~held_out) and int(held_out.sum()) == 40 * 24 // 2
    assert held_out[:12].float().mean() == pytest.approx(0.5, abs=0.1)  # everywhere alike
    drawn = scene.images.draw(5000, scene.splits["train"], generator)
    x, y = drawn.xy.long().unbind(1)
    assert learnt[y, x].all()
    again = open_scene(tmp_path / "wall.png")
    assert torch.equal(again.images.mask(0), scene.images.mask(0))


def test_both_shots_show_the_picture(tmp_path):
    path = write(tmp_path / "wall.png")
    scene = open_scene(str(path))
    truth = torch.from_numpy(np.array(Image.open(path))).float() / 255
    for index in range(2):
        assert torch.equal(scene.photograph(index).rgb, truth)


def test_large_pictures_are_reduced(tmp_path):
    path = write(tmp_path / "large.jpg", 1200, 600)
    assert open_scene(path).cameras.size[0].tolist() == [400, 200]  # a third, to at most 512
    assert open_scene(path, downscale=1).cameras.size[0].tolist() == [1200, 600]
    assert open_scene(path, downscale=10).cameras.size[0].tolist() == [120, 60]


def test_pictures_are_turned_upright(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6  # a quarter turn
    scene = open_scene(write(tmp_path / "phone.jpg", 40, 24, exif=exif))
    assert scene.cameras.size[0].tolist() == [24, 40]


def test_alpha_comes_along(tmp_path):
    pixels = np.full((20, 20, 4), 255, np.uint8)
    pixels[:10, :, 3] = 0
    Image.fromarray(pixels).save(tmp_path / "cut-out.png")
    scene = open_scene(tmp_path / "cut-out.png")
    assert scene.frame.has_alpha and scene.frame.background == (1.0, 1.0, 1.0)


def test_what_is_no_picture(tmp_path):
    (tmp_path / "text.png").write_text("not an image")
    (tmp_path / "notes.txt").write_text("nor this")
    (tmp_path / "folder.png").mkdir()
    write(tmp_path / "tiny.png", 12, 40)
    write(tmp_path / "wall.png")
    for name, words in (
        ("text.png", "cannot be read as an image"),
        ("notes.txt", "is a file; name the folder"),
        ("folder.png", "is empty"),
        ("tiny.png", "12x40 pixels .* 16 a side"),
        ("none.png", "does not exist"),
    ):
        with pytest.raises(LumigraphError, match=words):
            open_scene(tmp_path / name)
    with pytest.raises(LumigraphError, match="a smaller --downscale"):
        open_scene(tmp_path / "wall.png", downscale=2)
    with pytest.raises(LumigraphError, match="--downscale 0 cannot be"):
        open_scene(tmp_path / "wall.png", downscale=0)


def test_commands_take_a_picture_for_a_scene(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "my wall.png")
    assert main(["info", "my wall.png"]) == 0 and "2 of 40x24" in capsys.readouterr().out
    options = ["--steps", "4", "--device", "cpu", "--hidden-width", "16", "--frequencies", "8"]
    assert main(["train", "fourier-features", "my wall.png", *options]) == 0
    run = "runs/my-wall-fourier-features-1"
    assert main(["eval", run, "--device", "cpu"]) == 0 and "1 of test, 40x24" in capsys.readouterr().out
    assert main(["render", run, "--frames", "2", "--size", "32", "--device", "cpu"]) == 0
    assert main(["report", run]) == 0 and "1 photograph<" in (tmp_path / run / "report.html").read_text("utf-8")
