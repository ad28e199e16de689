"""What is said of training, in a log and on a terminal."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import pytest
import tiny
import torch
from budgets import budget

from lumigraph import methods
from lumigraph.budget import Budget
from lumigraph.datasets.scene import Batch
from lumigraph.opening import open_scene
from lumigraph.run import build
from lumigraph.system.console import console
from lumigraph.training import fit
from lumigraph.training.display import TrainingDisplay, how_long, learner, learnt_from, machine, sizes, time_left

pytestmark = budget("runs", 8)


def test_a_log_says_what_begins_and_where_it_ends(capsys):
    fit(tiny.method(), tiny.scene(), steps=20)
    told = capsys.readouterr().err
    first, memory, compiling, learner, *_, last = told.splitlines()
    assert re.fullmatch(
        r"Memory: photographs 0\.0 GB, in memory; voxel-grid up to 0\.0 GB with its optimizer state; 0\.0 GB for one "
        r"picture in training and evaluation; [\d.,]+ GB are free",
        memory,
    )
    assert first == "Learning from 9 photographs, 3 held out, 24x24 pixels" and compiling.startswith(
        "Compiling kernels"
    )
    assert learner.startswith("voxel-grid, ") and "numbers to learn, on the CPU with" in learner
    assert "for 20 steps" in learner
    assert re.fullmatch(r"100 %  \d+:\d\d trained · step 20 · PSNR of training photographs \d+\.\d\d dB", last)
    assert re.fullmatch(r"[^\x00-\x09\x0b-\x1f\x7f]*", told)


def test_photographs_that_were_reduced(tmp_path):
    folder = tiny.write_blender(tmp_path / "ball")
    told = learnt_from(open_scene(folder, downscale=2))
    assert told == "Learning from 9 photographs, 3 held out, 12x12 pixels, reduced from 24x24"
    assert "reduced" not in learnt_from(open_scene(folder))
    few = open_scene(folder, views=1)
    assert learnt_from(few).startswith("Learning from 1 photograph, 3 held out")
    two_sizes = replace(few, full_sizes=torch.tensor([[24, 24], [48, 24]]))
    assert learnt_from(two_sizes).endswith("24x24 pixels, reduced from 24x24 to 48x24")


def test_a_cloud_is_counted_before_and_while_it_learns():
    kind = methods.find("gaussian-splatting")
    method = build(kind, tiny.scene().frame, kind.smallest(), torch.device("cpu"), seed=0)
    assert learner("gaussian-splatting", method) == f"gaussian-splatting, {len(method.cloud):,} Gaussians"
    told = sizes({"mse": 0.1, "gaussians": 12_345.0, "rays": 7.0, "distance error": 0.0123})
    assert told == ["12,345 Gaussians", "distance error 0.0123"]


def test_how_long_it_will_take():
    assert how_long(Budget(seconds=600.0), 0, 0.0) == "for 10 min"
    assert how_long(Budget(seconds=600.0), 50, 540.0) == "for 60 s"
    assert how_long(Budget(seconds=5.0), 0, 7.73) == "without a step of learning"
    assert how_long(Budget(500, quality="draft"), 0, 0.0).startswith("for 500 steps (quality: draft); how long")
    assert "100 of them done" in how_long(Budget(500), 100, 9.0)
    assert machine(torch.device("cpu")).startswith("on the CPU with ")


def test_time_left_is_that_of_this_sitting():
    """Another machine's seconds say nothing of this one's."""
    assert time_left(Budget(300), 120, 1010.0, (100, 1000.0)) == pytest.approx(90.0)
    assert time_left(Budget(seconds=60.0), 120, 45.0, (100, 0.0)) == pytest.approx(15.0)


@pytest.fixture
def clock(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    return now


def learn(display: TrainingDisplay, clock: list[float], seconds: int, steps_per_second: int = 10) -> None:
    """Note so many steps, as the trainer does."""
    scene, budget = tiny.scene(), Budget(seconds=float(seconds))
    batch: Batch = scene.sample_rays(4, torch.Generator().manual_seed(0))
    display.begin(scene, "Memory: little")
    display.ready("voxel-grid", tiny.method(), budget, 0, 0.0)
    for step in range(1, seconds * steps_per_second + 1):
        clock[0] += 1 / steps_per_second
        row = {"psnr": 20.0, "statistics": {"gaussians": step}} if display.due else {}
        display.update(step, step / steps_per_second, budget, batch, row)
    display.done(step, float(seconds), 1.0)


@pytest.mark.parametrize(("seconds", "most"), [(60, 10), (3600, 90)])
def test_a_log_has_some_lines_of_any_training(clock, capsys, seconds, most):
    learn(TrainingDisplay(), clock, seconds)
    lines = [line for line in capsys.readouterr().err.splitlines() if "%" in line]
    assert most / 2 < len(lines) <= most
    left = re.search(r"about (\d+):(\d\d) left", lines[0])
    assert left and 0 < seconds - (60 * int(left[1]) + int(left[2])) <= 5  # the first comes within five seconds
    assert "Gaussians · PSNR of training photographs 20.00 dB" in lines[0]


def test_a_terminal_has_a_bar_and_figures_below(clock, monkeypatch):
    screen = io.StringIO()
    display = TrainingDisplay()
    display.console = display.bar.live.console = console(file=screen, force_terminal=True, width=100)
    display.terminal = True
    learn(display, clock, 5)
    display.console.print(display.bar.get_renderable())
    told = screen.getvalue()
    assert "Learning from 9 photographs" in told and "trained" in told
    assert "step 50 · PSNR of training photographs 20.00 dB" in told


def test_nothing_is_said_where_nothing_is_to_be_shown(capsys):
    fit(tiny.method(), tiny.scene(), steps=3, show=False)
    told = capsys.readouterr()
    assert told.err == told.out == ""
