"""Devices and pipes in place of files are refused: nothing waits for them or reads without end."""

from __future__ import annotations

import os
import re
import sys
import threading
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
from budgets import budget
from captures import WRITERS, Tiny
from PIL import Image
from test_depth_readers import write_polycam, write_record3d, write_replica, write_scannet

from lumigraph import files
from lumigraph.errors import LumigraphError
from lumigraph.exchange import read_gaussians
from lumigraph.files.atomic import MAX_TEXT_BYTES
from lumigraph.large import open_any
from lumigraph.opening import open_scene
from lumigraph.paths.keyframes import CameraPath
from lumigraph.run import Run

pytestmark = [budget("capture"), pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")]
PATIENCE = 20.0  # seconds


def zeros(place: Path) -> None:
    place.symlink_to("/dev/zero")


def outcome(call: Callable[[], object]) -> str:
    """Sentence of the LumigraphError that a call raises, "" if it returns. Fails where it waits for ever."""
    said: list[str | BaseException] = []

    def work() -> None:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                call()
            said.append("")
        except LumigraphError as fault:
            said.append(str(fault))
        except BaseException as fault:
            said.append(fault)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(PATIENCE)
    assert said, "it waits for a pipe, or reads a device"
    assert isinstance(said[0], str), repr(said[0])
    return said[0]


def write_tum(folder: Path) -> Path:
    folder.mkdir()
    for i, pose in enumerate(tiny.poses(4)):
        Image.fromarray(tiny.picture(pose)[..., :3]).resize((32, 24)).save(folder / f"{i}.png")
    rows = [f"{i} {i} 0 0 0 0 0 1" for i in range(4)]
    (folder / "rgb.txt").write_text("\n".join(f"{i} {i}.png" for i in range(4)))
    (folder / "groundtruth.txt").write_text("\n".join(rows))
    (folder / "camera.txt").write_text("32 32 12 12")
    return folder


def write_seven(folder: Path) -> Path:
    folder.mkdir()
    for i, pose in enumerate(tiny.poses(4)):
        Image.fromarray(tiny.picture(pose)[..., :3]).save(folder / f"frame-00000{i}.color.png")
        matrix = np.concatenate([pose.numpy(), [[0, 0, 0, 1]]])
        np.savetxt(folder / f"frame-00000{i}.pose.txt", matrix)
    np.savetxt(folder / "camera-intrinsics.txt", [[32, 0, 12], [0, 32, 12], [0, 0, 1]])
    return folder


LAYOUTS: dict[str, Callable[[Path], object]] = {
    **{name: partial(write, tiny=Tiny(4)) for name, write in WRITERS.items()},
    "tum": write_tum,
    "7-scenes": write_seven,
    "replica": write_replica,
    "scannet": write_scannet,
    "polycam": write_polycam,
    "record3d": write_record3d,
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_no_capture_waits_for_a_file_that_never_ends(tmp_path, name, monkeypatch):
    """Files of a folder whose names differ in more than a number, each in turn replaced by a device or a pipe."""
    monkeypatch.setitem(sys.modules, "liblzfse", SimpleNamespace(decompress=lambda data: data, error=RuntimeError))
    folder = tmp_path / "capture"
    LAYOUTS[name](folder)
    assert outcome(lambda: open_scene(folder)) == ""
    every = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    for number, place in enumerate({(path.parent, re.sub(r"\d+", "", path.name)): path for path in every}.values()):
        data = place.read_bytes()
        place.unlink()
        (zeros, os.mkfifo)[number % 2](place)
        said = outcome(lambda: open_scene(folder))  # refused, or left out as a missing one is
        assert "\n" not in said
        place.unlink()
        place.write_bytes(data)
    assert outcome(lambda: open_scene(folder)) == ""


@pytest.mark.parametrize("make", [zeros, os.mkfifo], ids=["device", "pipe"])
@pytest.mark.parametrize(
    ("name", "opened"),
    [
        ("composition.json", open_any),
        ("cloud.ply", open_any),
        ("cloud.spz", read_gaussians),
        ("cloud.splat", read_gaussians),
        ("cloud.sog", read_gaussians),
        ("cloud.glb", read_gaussians),
        ("cloud.4dgs", open_any),
        ("path.json", CameraPath.load),
        ("text", files.read_bytes),
    ],
)
def test_what_opens_is_an_ordinary_file(tmp_path, make, name, opened):
    make(tmp_path / name)
    assert "no ordinary file" in outcome(lambda: opened(tmp_path / name))


@pytest.mark.parametrize("name", ["config.json", "cameras.json", "metrics.jsonl", "checkpoints/000060/state.json"])
def test_no_run_waits_for_a_pipe(ball_run, tmp_path, name):
    import shutil

    folder = shutil.copytree(ball_run.folder, tmp_path / "run")
    (folder / name).unlink()
    os.mkfifo(folder / name)

    def use() -> None:
        run = Run(folder)
        run.metrics(), run.cameras(), run.method()

    said = outcome(use)
    assert "no ordinary file" in said or "holds no config.json" in said or "is not a run" in said


def test_a_file_of_text_has_a_size_that_is_sound(tmp_path):
    path = tmp_path / "transforms.json"
    with open(path, "wb") as file:
        file.truncate(MAX_TEXT_BYTES + 1)  # a hole, which takes no room
    with pytest.raises(LumigraphError, match=r"transforms\.json has 268,435,457 bytes, and 268,435,456 are the most"):
        open_scene(tmp_path)
