"""Loggers: what a training measures arrives, and each format is opened by its own reader where that is installed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import tiny
from budgets import budget

import lumigraph
from lumigraph.commands.cli import main
from lumigraph.errors import LumigraphError
from lumigraph.run.records import flat
from lumigraph.training import loggers
from lumigraph.training.loop import fit

pytestmark = budget("runs", 8)
OPTIONS = {"steps": 20, "cells": 6, "views": 4, "device": "cpu"}


class Memory:
    """A logger that remembers."""

    def __init__(self) -> None:
        self.options: dict[str, Any] = {}
        self.rows: dict[int, dict[str, float]] = {}
        self.pictures: list[tuple[int, str, tuple[int, ...]]] = []
        self.ended = 0

    def begin(self, run, options):
        self.options = dict(options)

    def scalars(self, step, values):
        self.rows[step] = dict(values)

    def picture(self, step, name, rgb):
        self.pictures.append((step, name, tuple(rgb.shape)))

    def end(self):
        self.ended += 1


def test_rows_are_flat():
    nested = {"learning_rate": [0.1, 0.2], "a": {"b": {"c": 1}}}
    found = flat({"step": 3, "terms": {"tv": 0.5}, "statistics": {"rays": 2.0}} | nested)
    lists = {"learning_rate/0": 0.1, "learning_rate/1": 0.2, "a/b/c": 1}
    assert found == {"step": 3, "loss/tv": 0.5, "figures/rays": 2.0} | lists


def test_a_training_tells_its_loggers(ball_folder, tmp_path):
    memory = Memory()
    run = lumigraph.train(ball_folder, "voxel-grid", tmp_path / "run", loggers=[memory], **OPTIONS)
    assert set(memory.rows) == {10, 20} and memory.ended == 1
    table = run.metrics()
    for step, row in memory.rows.items():
        at = table["step"].tolist().index(step)
        assert row["loss/colour"] == table["loss/colour"][at] and row["loss"] == table["loss"][at]
    assert flat(run.settings.config).items() <= memory.options.items() and "commit" in memory.options
    assert memory.options["budget/steps"] == 20
    assert {step for step, _, _ in memory.pictures} == set(run.previews())
    memory = Memory()
    lumigraph.call("resume", run, steps=30)
    assert memory.rows == {}


def test_a_fault_ends_the_loggers_too(ball_folder, tmp_path):
    memory = Memory()

    def failing(step, share, row):
        raise LumigraphError("enough")

    with pytest.raises(LumigraphError, match="enough"):
        lumigraph.train(ball_folder, "voxel-grid", tmp_path / "r", loggers=[memory], progress=failing, **OPTIONS)
    assert memory.ended == 1


def test_what_is_no_logger_is_refused(ball_folder, tmp_path, capsys):
    with pytest.raises(LumigraphError, match="no logger 'tensorbord'; there are: tensorboard, wandb"):
        lumigraph.train(ball_folder, "voxel-grid", tmp_path / "a", log=["tensorbord"], **OPTIONS)
    with pytest.raises(LumigraphError, match="is no logger; it needs begin"):
        loggers.logger_of(object())
    assert not (tmp_path / "a" / "config.json").exists(), "nothing is begun"
    data = tiny.scene()
    kind = lumigraph.methods.find("voxel-grid")
    with pytest.raises(LumigraphError, match="for a run"):
        fit(kind(data.frame, kind.Config()), data, steps=1, loggers=[Memory()])
    assert main(["train", "voxel-grid", str(ball_folder), "--log", "nothing", "--output", str(tmp_path / "c")]) == 2
    assert "no logger 'nothing'" in capsys.readouterr().err


def test_a_missing_package_is_named(ball_folder, tmp_path, monkeypatch):
    def begin(self, run, options):
        raise ImportError("No module named 'wandb'")

    monkeypatch.setattr(loggers.WandbLogger, "begin", begin)
    with pytest.raises(LumigraphError, match=r"No module named 'wandb'\); pip install wandb"):
        lumigraph.train(ball_folder, "voxel-grid", tmp_path / "run", loggers=["wandb"], **OPTIONS)


def trained(name: str, scene: Path, folder: Path) -> lumigraph.Model:
    return lumigraph.train(scene, "voxel-grid", folder / "run", log=[name], **OPTIONS)


def test_tensorboard_reads_its_events(ball_folder, tmp_path):
    reader = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    run = trained("tensorboard", ball_folder, tmp_path)
    found = reader.EventAccumulator(str(run.path / "tensorboard"))
    found.Reload()
    events = found.Scalars("loss/colour")
    assert [event.step for event in events] == [10, 20]
    assert [event.value for event in events] == pytest.approx(run.metrics()["loss/colour"].tolist())
    assert found.Images("preview")[0].width == tiny.SIZE and "options/text_summary" in found.Tags()["tensors"]


def test_rerun_reads_its_recording(ball_folder, tmp_path):
    pytest.importorskip("rerun")
    run = trained("rerun", ball_folder, tmp_path)
    words = [sys.executable, "-m", "rerun", "rrd", "print", str(run.path / "rerun.rrd")]
    told = subprocess.run(words, capture_output=True, text=True, check=True, timeout=60).stdout
    for name, column in (("/loss/colour", "Scalars:scalars"), ("/preview", "Image:buffer"), ("/options", "text")):
        assert any(name in line and column in line for line in told.splitlines()), told


def test_wandb_reads_its_offline_run(ball_folder, tmp_path):
    """Its file holds records of protocol buffers, whose names are plain text; its program says that it can be sent."""
    pytest.importorskip("wandb")
    run = trained("wandb", ball_folder, tmp_path)
    (folder,) = (run.path / "wandb").glob("offline-run-*")
    (file,) = folder.glob("*.wandb")
    assert b"loss/colour" in file.read_bytes() and list((folder / "files" / "media" / "images").glob("preview*.png"))
    words = [sys.executable, "-m", "wandb", "sync", "--dry-run", str(folder)]
    told = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert told.returncode == 0 and folder.name in told.stdout + told.stderr


def test_trackio_reads_its_base(ball_folder, tmp_path, monkeypatch):
    storage = pytest.importorskip("trackio.sqlite_storage")
    monkeypatch.setattr("trackio.utils.TRACKIO_DIR", tmp_path / "base")
    monkeypatch.setattr(storage, "TRACKIO_DIR", tmp_path / "base")
    run = trained("trackio", ball_folder, tmp_path)
    rows = storage.SQLiteStorage.get_logs("lumigraph", run.path.name)
    found = {row["step"]: row["loss/colour"] for row in rows if "loss/colour" in row}
    assert found == pytest.approx(dict(zip([10, 20], run.metrics()["loss/colour"].tolist(), strict=True)))
    assert any("preview" in row for row in rows)
