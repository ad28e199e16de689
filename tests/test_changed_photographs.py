"""Photographs that changed since training are noticed, whatever opens them again."""

from __future__ import annotations

import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import tiny
from budgets import budget
from PIL import Image

from lumigraph.commands.cli import main
from lumigraph.errors import LumigraphWarning
from lumigraph.opening import open_scene
from lumigraph.readers.pictures import digest_of
from lumigraph.run import Run

pytestmark = budget("runs", 6)


@pytest.fixture(scope="module")
def learnt(ball_folder, tmp_path_factory) -> tuple[Path, Path]:
    """A run, and the photographs that it has learnt from."""
    photographs = shutil.copytree(ball_folder, tmp_path_factory.mktemp("photographs") / "ball")
    folder = tmp_path_factory.mktemp("runs") / "ball"
    assert main(["train", "voxel-grid", str(photographs), "--steps", "2", "--cells", "6", "--output", str(folder)]) == 0
    return folder, photographs


def test_the_same_photographs_are_not_warned_of(learnt):
    folder, photographs = learnt
    with warnings.catch_warnings():
        warnings.simplefilter("error", LumigraphWarning)
        Run(folder).dataset()
    assert len(set(Run(folder).digests().values())) == 12


def test_a_changed_photograph_is_named_by_eval_and_resume(learnt, tmp_path, capsys):
    photographs = shutil.copytree(learnt[1], tmp_path / "ball")
    run = str(shutil.copytree(learnt[0], tmp_path / "run"))
    pixels = np.array(Image.open(photographs / "train_1.png"))
    pixels[10, 10, 0] ^= 1
    Image.fromarray(pixels).save(photographs / "train_1.png")
    told = ["--scene", str(photographs), "--device", "cpu"]
    words = f"1 photograph of {photographs} changed since {run} learnt from them: ./train_1"
    assert main(["eval", run, *told]) == 0 and words in capsys.readouterr().err
    assert main(["resume", run, "--steps", "3", *told]) == 0 and words in capsys.readouterr().err


def test_a_run_of_an_older_kind_knows_nothing_of_them(learnt, tmp_path):
    run = shutil.copytree(learnt[0], tmp_path / "run")
    said = json.loads((run / "cameras.json").read_text())
    del said["digests"]
    (run / "cameras.json").write_text(json.dumps(said))
    assert Run(run).digests() == {} and len(Run(run).dataset()) == 12


def test_the_digest_knows_size_and_content(tmp_path):
    path, data = tmp_path / "a", bytearray(1 << 20)
    path.write_bytes(data)
    first = digest_of(path)
    path.write_bytes(data[:-1])
    assert digest_of(path) != first
    data[(1 << 19) + 5] = 1
    path.write_bytes(data)
    assert digest_of(path) != first and digest_of(path).startswith(f"{1 << 20}-")


def test_copies_at_several_sizes_have_the_digest_of_their_photograph(tmp_path, ball_folder):
    scene = open_scene(ball_folder, scales=2)
    assert len(scene.digests) == len(scene) == 24 and scene.digests[:12] == scene.digests[12:]


def test_a_printed_scene_is_five_lines(ball_folder):
    lines = repr(open_scene(ball_folder)).splitlines()
    assert len(lines) == 5 and "12 photographs: 9 train, 3 test" in lines[0] and "24x24 pixels" in lines[1]
    assert len(repr(tiny.scene()).splitlines()) == 5
