"""Calls from Python: options become those of the command line, faults are raised, training is told of and ended."""

from __future__ import annotations

import copy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny
import torch
import tyro
from budgets import budget

import lumigraph
from lumigraph.commands.calls import command
from lumigraph.commands.cli import COMMANDS, main, parse
from lumigraph.errors import LumigraphError
from lumigraph.run import Run
from lumigraph.run.checkpoint import Checkpoints

pytestmark = budget("runs", 9)  # 9.4 s, 3 of them for a process that loads all public names


BOX = [0.0, 0.0, 0.0, 1.0, 1.0, 1.5]
SETTING = {"set": {"time": 0.3, "light": 2}, "animate": {"time": "0:1"}, "size": np.int64(64), "depth": True}


@pytest.mark.parametrize(
    ("name", "words", "arguments", "options"),
    [
        ("capture", "a b --frames 9", (Path("a"), "b"), {"frames": 9}),
        ("render", "run --set time=0.3 --set light=2 --animate time=0:1 --size 64 --depth", (Path("run"),), SETTING),
        ("eval", "run --lpips a.pth", ("run",), {"lpips": "a.pth", "views": None}),
        (
            "export mesh",
            f"run a.glb --from depth --no-origin --box {' '.join(map(str, BOX))}",
            ("run", "a.glb"),
            {"from_": "depth", "origin": False, "box": np.array(BOX)},
        ),
        ("export splats", "run new --lod --levels 3", ("run", "new"), {"lod": True, "levels": 3}),
        ("export web", "run a.html --as views", ("run", "a.html"), {"as_": "views"}),
        ("export stereo", "run a.png --from 0 1 2", ("run", "a.png"), {"from_": torch.tensor([0.0, 1.0, 2.0])}),
        ("explain ray", "run --view 3", ("run",), {"view": 3}),
        ("train", "nerf scene --preset paper --steps 9", ("nerf", Path("scene")), {"preset": "paper", "steps": 9}),
        ("train", "voxel-grid scene --cells 6 --no-stay", ("voxel-grid", "scene"), {"cells": 6, "stay": False}),
        ("train", "block-nerf x --field instant-ngp", ("block-nerf", "x"), {"field": "instant-ngp"}),
        ("train", "captions", ("captions",), {}),
        ("track", "imap rec", (), {"method": "imap", "recording": "rec"}),
        ("convert", "run plenoxels --output new", ("run", "plenoxels"), {"output": Path("new")}),
        ("convert", "--list", (), {"list": True}),
    ],
)
def test_options_are_those_of_the_command_line(name, words, arguments, options):
    typed = parse([*name.split(), *words.split()])
    assert repr(command(name, *arguments, **options)) == repr(typed.what if " " in name else typed)


def test_every_command_can_be_made_of_values():
    """Each with text for what it needs, or refused in a sentence that names an option."""
    for name in [*set(COMMANDS) - {"bench", "explain", "export"}, "bench step", "export points", "explain activation"]:
        try:
            assert callable(command(name).run)
        except LumigraphError as fault:
            assert f"`lumigraph {name}` lacks " in str(fault)


def test_a_run_is_trained_told_of_ended_and_resumed(ball_folder, tmp_path, capsys):
    told = []

    def progress(step, share, row):
        told.append((step, share, row))
        return step >= 20

    scene = lumigraph.open_scene(ball_folder, views=6)
    run = lumigraph.train(scene, "voxel-grid", tmp_path / "run", steps=30, cells=6, progress=progress)
    assert run.state.step == 20 and [step for step, _, _ in told] == list(range(1, 21))
    assert told[-1][2]["loss"] > 0 and told[0][2] == {}
    assert '"cells": 6' in (run.path / "config.json").read_text() and run.settings.splits["train"] == 6
    assert capsys.readouterr().out == ""
    rows = lumigraph.call("resume", run.path)
    assert lumigraph.open(run.path).state.step == 30 and rows["run"] == str(run.path)


@pytest.fixture
def own_run(ball_run, tmp_path) -> lumigraph.Model:
    """A copy of the run, which may be written to."""
    shutil.copytree(ball_run.path, tmp_path / "run")
    return lumigraph.open(tmp_path / "run")


def test_a_run_renders_its_latest_state(ball_run):
    camera = ball_run.cameras()["test"][0]
    first = ball_run.render(camera)
    assert first.rgb.shape == (tiny.SIZE, tiny.SIZE, 3)
    method = ball_run._ready[1]
    assert (ball_run.render(camera).rgb == first.rgb).all() and ball_run._ready[1] is method
    again = type(ball_run)(ball_run.path)
    again._ready = ("an earlier state", "cpu", 1.0), method
    assert (again.render(camera).rgb == first.rgb).all() and again._ready[1] is not method


def test_several_cameras_make_a_batch(ball_run):
    run = lumigraph.Model(ball_run)
    cameras = run.cameras()["train"][:3]
    one, several, listed = run.render(cameras[1]), run.render(cameras), run.render([cameras[1]])
    assert several.rgb.shape == (3, tiny.SIZE, tiny.SIZE, 3) and listed.depth.shape == (1, tiny.SIZE, tiny.SIZE)
    assert (several.rgb[1] == one.rgb).all() and (listed.depth[0] == one.depth).all()
    mixed = run.render([cameras[0], cameras[1].resized(0.5)])
    assert [one.depth.shape[0] for one in mixed] == [tiny.SIZE, tiny.SIZE // 2]
    with pytest.raises(LumigraphError, match="no cameras"):
        run.render([])


def test_depth_is_in_the_unit_of_exports(own_run):
    camera = own_run.cameras()["test"][0]
    before = own_run.render(camera).depth
    assert torch.allclose(before, own_run.opened.render(camera).depth * own_run.frame.to_source.scale)
    own_run.set_scale(2.5)
    assert torch.allclose(own_run.render(camera).depth, 2.5 * before)


def test_weights_are_loaded_once_for_all_calls(own_run, tmp_path, monkeypatch):
    """A script of pictures, a film, exports and an evaluation neither opens the run again nor changes its weights."""
    loads, opens = [], []
    load, begin = Checkpoints.load_weights, Run.__init__
    monkeypatch.setattr(Checkpoints, "load_weights", lambda self, method: (loads.append(self), load(self, method)))
    monkeypatch.setattr(Run, "__init__", lambda self, folder: (opens.append(folder), begin(self, folder))[1])
    monkeypatch.setattr(Run, "dataset", lambda *_: tiny.scene())
    own_run.render(own_run.cameras()["test"][0])
    weights = {name: value.clone() for name, value in own_run.ready().state_dict().items()}
    film = own_run.film(tmp_path / "film.gif", frames=2, size=16)
    mesh = own_run.export("mesh", tmp_path / "a.ply", size=16, views=4, cell_size=0.2, smooth=0)
    own_run.export("panorama", tmp_path / "b.png", size=64)
    found = own_run.evaluate(views=2)
    assert (len(loads), opens) == (1, [])
    assert all(torch.equal(value, weights[name]) for name, value in own_run.ready().state_dict().items())
    assert (film.frames, film.size) == (2, (16, 16)) and film.seconds_per_frame == film.seconds / 2 > 0
    assert Path(film).is_file() and film.cameras.is_file() and film.depth is None
    assert mesh.counts["triangles"] > 10 and mesh.bytes == Path(mesh).stat().st_size
    assert found.psnr == found["psnr"] == lumigraph.open(own_run.path).evaluation()["psnr"] and len(found.views) == 2
    assert len(opens) == 1 and found.path.name == "eval.json"


@pytest.mark.parametrize("how", ["raise", "true"])
@pytest.mark.parametrize("work", ["film", "mesh", "points", "web", "evaluate"])
def test_work_is_heard_of_and_cancelled_without_a_trace(work, how, own_run, tmp_path, monkeypatch):
    """Its function hears of stages; an exception of it, and true, end the work before any file is there."""
    heard = []

    def progress(description, count, total):
        heard.append((description, count, total))
        if how == "raise" and count == 1:
            raise ValueError("enough")
        return count == 1

    monkeypatch.setattr(Run, "dataset", lambda *_: tiny.scene())
    small = {"size": 16, "views": 4, "progress": progress}
    calls = {
        "film": lambda: own_run.film(tmp_path / "new.gif", frames=3, size=16, progress=progress),
        "mesh": lambda: own_run.export("mesh", tmp_path / "new.ply", cell_size=0.2, **small),
        "points": lambda: own_run.export("points", tmp_path / "new.ply", **small),
        "web": lambda: own_run.export("web", tmp_path / "new.html", as_="views", **small),
        "evaluate": lambda: own_run.evaluate(views=2, progress=progress),
    }
    before = {path: path.read_bytes() for path in own_run.path.rglob("*") if path.is_file()}
    with pytest.raises(ValueError if how == "raise" else KeyboardInterrupt):
        calls[work]()
    assert heard[0][1] == 0 and heard[-1][1] == 1 and all(total is None or count <= total for _, count, total in heard)
    assert not list(tmp_path.glob("new*")) and not list(tmp_path.glob(".*partial*"))
    assert {path: path.read_bytes() for path in own_run.path.rglob("*") if path.is_file()} == before


def test_a_conversion_that_is_cancelled_goes_on(own_run, tmp_path):
    heard = []

    def progress(description, count, total):
        heard.append(description)
        return (description, count) == ("Training", 2)

    options = {"steps": 4, "views": 1}
    with pytest.raises(KeyboardInterrupt):
        own_run.convert("voxel-grid", tmp_path / "new", progress=progress, **options)
    assert heard[-1] == "Training" and len(set(heard)) > 1
    assert own_run.convert("voxel-grid", tmp_path / "new", **options).state.step == 4


def test_training_that_is_cancelled_keeps_its_last_state(ball_folder, tmp_path):
    """A fault of the function ends it, and the run opens or is not there."""

    def progress(step, share, row):
        if step == 5:
            raise ValueError("enough")

    with pytest.raises(ValueError, match="enough"):
        lumigraph.train(ball_folder, "voxel-grid", tmp_path / "run", steps=30, cells=6, progress=progress)
    assert not (tmp_path / "run").exists() or lumigraph.open(tmp_path / "run").state.step <= 5


def test_a_model_has_all_that_was_opened(own_run, tmp_path):
    assert (
        own_run.frame == own_run.opened.frame and own_run.state.step == 60 and copy.copy(own_run).path == own_run.path
    )
    assert str(own_run.path) in repr(own_run) and not hasattr(own_run, "colour")
    table = own_run.metrics()
    assert table["step"][-1] == 60 and {len(column) for column in table.values()} == {len(own_run.opened.metrics())}
    again = own_run.convert("voxel-grid", tmp_path / "again", steps=1, views=1)
    assert isinstance(again, lumigraph.Model) and again.state.step == 1


def test_python_parses_no_command_line(own_run, tmp_path, monkeypatch):
    monkeypatch.setattr(tyro, "cli", lambda *_, **__: pytest.fail("words were parsed"))
    assert lumigraph.call("render", own_run, output=tmp_path / "a.gif", frames=1, size=16)["frames"].startswith("1 of")
    assert own_run.film(tmp_path / "b.gif", frames=1, size=16).rows["frames"].startswith("1 of")


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: lumigraph.train("nowhere", "voxel-grid"), "nowhere"),
        (lambda: lumigraph.train("nowhere", "voxel-grid", cellz=6), "cellz"),
        (
            lambda: lumigraph.train("nowhere", "voxel-grid", steps=-3),
            "Option steps of .* is -3, and should be from 1 to",
        ),
        (lambda: lumigraph.call("export mesh", "run", "a.glb", from_="up"), "Option from .* and should be auto or "),
        (lambda: lumigraph.call("render", "run", "film"), "`lumigraph render` is given 1 argument too many"),
        (lambda: lumigraph.call("clean", "run"), "`lumigraph clean` lacks output"),
        (lambda: lumigraph.call("view", "run", token="secret"), "no option token"),
        (lambda: lumigraph.call("render", "run", size=object()), "Option size of `lumigraph render`"),
        (lambda: lumigraph.train(tiny.scene(), "voxel-grid"), "in memory"),
        (lambda: lumigraph.call("export nothing", "run", "file"), "nothing"),
    ],
)
def test_a_fault_is_raised(call, said):
    with pytest.raises(LumigraphError, match=said):
        call()


PUBLIC_NAMES = """
Camera Collection Dataset Evaluation Exported Film Gaussians Lens LumigraphError Method Model Opened RayMethod Rays
Rendering Run Samples Scene Shapes call capture composite fit open open_any open_dataset open_scene rasterization
rasterization_2dgs sample train
""".split()
MODEL_NAMES = """
clean compress convert depth_unit evaluate export film metrics opened placed render rendered
""".split()


def test_public_names_are_these(ball_run):
    """A name that goes, or changes, is a change that CHANGELOG.md has to tell of."""
    assert sorted(lumigraph.__all__) == PUBLIC_NAMES and dir(lumigraph) == sorted([*PUBLIC_NAMES, "__version__"])
    assert sorted(dir(lumigraph.Model(ball_run))) == MODEL_NAMES and len(MODEL_NAMES) <= 20


def test_what_is_open_is_one_line(ball_run, ball_folder, tmp_path):
    run, scene = lumigraph.Model(ball_run), lumigraph.open_scene(ball_folder)
    lines = {
        repr(run): ("Model of Run", "voxel-grid", "60 steps"),
        repr(run.ready()): ("VoxelGrid", "parameters", "bounded", "on cpu"),
        repr(scene.cameras): (f"{len(scene)} Pinhole", f"{tiny.SIZE}x{tiny.SIZE} pixels"),
        repr(scene.cameras[0]): ("1 Pinhole", "at ["),
    }
    for line, words in lines.items():
        assert "\n" not in line and len(line) < 300 and all(word in line for word in words), line
    film = run.film(tmp_path / "a.gif", frames=2, size=16)
    assert (
        repr(film).startswith(f"Film {tmp_path / 'a.gif'}: 2 frames of 16x16")
        and "data:image/gif" in film._repr_html_()
    )
    assert scene._repr_html_().count("<img") == 4 and "Scene of" in scene._repr_html_()


@pytest.mark.parametrize("name", ["still-life", "room"])
def test_samples_open_everywhere(name, tmp_path, capsys):
    run = lumigraph.sample(name)
    assert (run.depth_unit == "metres") == (name == "room") and 5000 < len(run.gaussians) <= 60_000
    assert run.path.stat().st_size < 1_500_000
    seen = run.render(run.cameras()["train"][0].resized(0.1))
    assert seen.opacity.max() > 0.9 and seen.rgb.std() > 0.05
    assert main(["export", "splats", f"sample:{name}", str(tmp_path / "a.ply")]) == 0
    assert main(["render", f"sample:{name}", "--frames", "1", "--size", "16", "--output", str(tmp_path / "a.gif")]) == 0
    assert main(["info", f"sample:{name}"]) == 0
    both = tmp_path / "both.json"
    assert main(["compose", f"sample:{name}", "sample:still-life", "--at", "0", "0", "0", "--output", str(both)]) == 0
    assert lumigraph.open(both).cameras()
    capsys.readouterr()
    assert main(["info", "sample:nothing"]) == 2 and "there are: still-life, room" in capsys.readouterr().err


def test_public_names_are_there_from_the_start():
    """In a process of their own, where nothing else has loaded a package."""
    asked = "import lumigraph; print(callable(lumigraph.capture), [getattr(lumigraph, x) for x in lumigraph.__all__])"
    found = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True)
    assert found.stdout.startswith("True"), found.stderr


def test_the_package_of_captures_is_a_call(monkeypatch):
    seen = {}
    monkeypatch.setattr("lumigraph.api.call", lambda name, *given, **options: seen.update(options, name=name))
    monkeypatch.setattr("lumigraph.api.open_scene", lambda folder: tiny.scene() if folder == Path("scene") else None)
    assert len(lumigraph.capture("photos", "scene", frames=20).cameras) > 1
    assert seen["name"] == "capture" and seen["frames"] == 20
