"""Calls from Python: options become those of the command line, faults are raised, training is told of and ended."""

from __future__ import annotations

import subprocess
import sys

import pytest
import tiny
from budgets import budget

import lumigraph
from lumigraph.commands.calls import typed
from lumigraph.errors import LumigraphError

pytestmark = budget("runs", 9)  # 9.4 s, 3 of them for a process that loads all public names


def test_options_are_those_of_the_command_line():
    options = {"few_views": "yes", "view": True, "holes": False, "at": (0, 1.5), "seed": None, "from_": "depth"}
    assert typed({**options, "set": {"time": 0.3, "light": 2}}) == [
        *("--few-views", "yes", "--view", "--no-holes", "--at", "0", "1.5", "--from", "depth"),
        *("--set", "time=0.3", "--set", "light=2"),
    ]


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


def test_a_run_renders_its_latest_state(ball_run, tmp_path):
    camera = ball_run.cameras()["test"][0]
    first = ball_run.render(camera)
    assert first.rgb.shape == (tiny.SIZE, tiny.SIZE, 3)
    method = ball_run._ready[1]
    assert (ball_run.render(camera).rgb == first.rgb).all() and ball_run._ready[1] is method
    again = type(ball_run)(ball_run.path)
    again._ready = ("an earlier state", "cpu"), method
    assert (again.render(camera).rgb == first.rgb).all() and again._ready[1] is not method


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: lumigraph.train("nowhere", "voxel-grid"), "nowhere"),
        (lambda: lumigraph.train("nowhere", "voxel-grid", cellz=6), "cellz"),
        (lambda: lumigraph.train("nowhere", "voxel-grid", steps=-3), "--steps cannot be -3"),
        (lambda: lumigraph.train(tiny.scene(), "voxel-grid"), "in memory"),
        (lambda: lumigraph.call("export nothing", "run", "file"), "nothing"),
    ],
)
def test_a_fault_is_raised(call, said):
    with pytest.raises(LumigraphError, match=said):
        call()


def test_public_names_are_there_from_the_start():
    """In a process of their own, where nothing else has loaded a package."""
    asked = "import lumigraph; print(callable(lumigraph.capture), [getattr(lumigraph, x) for x in lumigraph.__all__])"
    found = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True)
    assert found.stdout.startswith("True"), found.stderr


def test_the_package_of_captures_is_a_call(monkeypatch):
    seen = {}
    monkeypatch.setattr(
        "lumigraph.commands.calls.call", lambda name, *given, **options: seen.update(options, name=name)
    )
    monkeypatch.setattr("lumigraph.commands.calls.open_scene", lambda folder: folder)
    assert str(lumigraph.capture("photos", "scene", frames=20)) == "scene"
    assert seen["name"] == "capture" and seen["frames"] == 20
