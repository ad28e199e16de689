"""Files that are passed on hold no place on Earth unless asked: neither a capture's origin nor a photograph's EXIF."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import pytest
from budgets import budget
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from lumigraph.app.pictures import thumbnail
from lumigraph.commands.cli import main
from lumigraph.commands.export import What
from lumigraph.commands.export_menu import export_menu
from lumigraph.commands.photo3d import Photo3DCommand
from lumigraph.datasets.scene import GeographicOrigin
from lumigraph.export import mesh_file
from lumigraph.large import open_any

pytestmark = budget("exports", 6)
ORIGIN = GeographicOrigin(50.0871234, 14.4213579, 230.5)
MESH = "--views 4 --size 40 --level 2 --cell-size 0.2"
EXPORTS = {  # of a run of a density field, which are quick
    "mesh a.glb": MESH,
    "mesh a.ply": MESH,
    "mesh a.obj": MESH,
    "points a.ply": "--size 60",
    "probes folder": "--counts 2 2 2 --resolution 4",
    "web a.html": "--as views --views 2 --size 32",
    "panorama a.png": "--size 128",
    "lightfield folder": "--grid 2 --size 32",
}


@pytest.fixture(scope="module")
def run(ball_run, tmp_path_factory) -> Path:
    """A run whose photographs had GPS."""
    folder = shutil.copytree(ball_run.folder, tmp_path_factory.mktemp("placed") / "run")
    config = json.loads((folder / "config.json").read_text())
    config["frame"]["origin"] = ORIGIN.to_json()
    (folder / "config.json").write_text(json.dumps(config))
    assert open_any(folder).frame.origin == ORIGIN
    return folder


def holds_place(path: Path) -> bool:
    files = path.rglob("*") if path.is_dir() else path.parent.glob(f"{path.stem}*")
    return any(b"50.0871" in file.read_bytes() for file in files if file.is_file())


@pytest.mark.parametrize("export", EXPORTS)
def test_exports_tell_the_place_only_with_a_sentence(run, tmp_path, capsys, export):
    kind, name = export.split()
    kinds = {marks.name: command for command, marks in map(get_args, get_args(What))}
    words = ["export", kind, str(run), str(tmp_path / name), *EXPORTS[export].split()]
    assert main(words) == 0
    said = capsys.readouterr().out
    held = holds_place(tmp_path / name)
    assert (
        held
        == ("latitude 50.087123" in said)
        == ("--no-origin leaves" in said)
        == ("obj" not in name) * ("origin" in {field.name for field in fields(kinds[kind])})
    )
    if held:
        shutil.rmtree(tmp_path / name, ignore_errors=True)
        assert main([*words, "--no-origin"]) == 0 and "latitude" not in capsys.readouterr().out
        assert not holds_place(tmp_path / name)


def test_every_command_that_can_write_an_origin_can_leave_it_out():
    kinds = {marks.name: command for command, marks in map(get_args, get_args(What))} | {"photo3d": Photo3DCommand}
    having = {name for name, command in kinds.items() if "origin" in {field.name for field in fields(command)}}
    assert having == {"mesh", "collision", "points", "probes", "photo3d"}
    assert {*mesh_file.WITH_ORIGIN} == {".ply", ".glb"}


def test_the_viewer_leaves_the_place_out_unless_asked(run):
    opened = open_any(run)
    menu = export_menu(opened, opened.method(), (), "auto")
    offered = {option.name: option.default for option in menu.formats["mesh"].options}
    assert offered["origin"] is False
    request = SimpleNamespace(crop=None, cleaned=False, settings=())
    assert "--no-origin" in menu.command("mesh", "a.glb", offered, request)
    assert "--no-origin" not in menu.command("mesh", "a.glb", offered | {"origin": True}, request)


@pytest.mark.parametrize("ending", ["JPEG", "PNG", "WEBP"])
def test_thumbnails_hold_pixels_alone(tmp_path, ending):
    exif, text = Image.Exif(), PngInfo()
    exif[0x010E] = "secret"
    exif.get_ifd(0x8825).update({1: "N", 2: (50.0, 5.0, 13.6), 3: "E", 4: (14.0, 25.0, 16.9)})
    text.add_text("comment", "secret")
    more = {"PNG": {"pnginfo": text}, "JPEG": {"comment": "secret", "xmp": b"secret"}, "WEBP": {"xmp": b"secret"}}
    path = tmp_path / f"a.{ending.lower()}"
    Image.new("RGB", (60, 40), "red").save(path, ending, exif=exif, **more.get(ending, {}))
    assert b"secret" in path.read_bytes() and Image.open(path).getexif().get_ifd(0x8825)
    made = thumbnail(path, 32)
    assert b"secret" not in made and b"Exif" not in made
    with Image.open(io.BytesIO(made)) as image:
        assert image.size == (32, 21) and not image.getexif() and "comment" not in image.info
