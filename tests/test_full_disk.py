"""A disk that is full at any write: whatever is left, the same command or `resume` goes on with it."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest
from budgets import budget
from test_priors import prior_run

from lumigraph import methods
from lumigraph.commands.cli import main
from lumigraph.derive.conversion import convert
from lumigraph.derive.options import ConvertOptions
from lumigraph.errors import LumigraphError
from lumigraph.run import Run
from lumigraph.run.derived import Converted

pytestmark = budget("runs", 15)

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class Disk:
    """A disk that has room for so many files, each of which is synchronized before it takes its place."""

    def __init__(self, monkeypatch, room: int):
        self.room, self.patch, self.sync = room, monkeypatch, os.fsync
        monkeypatch.setattr(os, "fsync", self.take)

    def take(self, descriptor: int) -> None:
        self.room -= not stat.S_ISDIR(os.fstat(descriptor).st_mode)
        if self.room < 0:
            raise FULL
        self.sync(descriptor)

    def free(self) -> None:
        self.patch.setattr(os, "fsync", self.sync)


def each_write(
    monkeypatch, work: Callable[[Path], int], again: Callable[[Path], object], tmp_path: Path, step: int = 1
):
    """Do a work on disks with room for 0, 1, 2 ... files, and `again` after some is freed, until the work succeeds."""
    for room in range(0, 1000, step):
        folder = tmp_path / f"room{room}" / "run"
        folder.parent.mkdir()
        disk = Disk(monkeypatch, room)
        code = work(folder)
        disk.free()
        if code == 0:
            assert room > step
            return
        again(folder)
        assert not [path for path in folder.parent.rglob("*") if path.name.endswith(".partial")]
    pytest.fail("never enough room")


def goes_on(capsys, command: list[str], folder: Path) -> None:
    """The same command works; or it names `resume`, which goes on or finds all done."""
    capsys.readouterr()
    if main([*command, str(folder)]) == 0:
        return
    assert f"go on with it by `lumigraph resume {folder}`" in capsys.readouterr().err
    assert main(["resume", str(folder)]) == 0 or "has spent its budget" in capsys.readouterr().err
    assert Run(folder).state.step == 3


def failed(capsys, command: list[str], folder: Path) -> int:
    capsys.readouterr()
    code = main([*command, str(folder)])
    assert code == 0 or "because the disk is full; free some space and try again" in capsys.readouterr().err
    return code


def test_training_goes_on_after_any_write_that_failed(ball_folder, tmp_path, capsys, monkeypatch):
    command = ["train", "voxel-grid", str(ball_folder), "--steps", "3", "--cells", "6", "--device", "cpu", "--output"]
    work, again = (lambda folder: failed(capsys, command, folder)), (lambda folder: goes_on(capsys, command, folder))
    each_write(monkeypatch, work, again, tmp_path, step=3)


def test_a_full_disk_before_the_first_state_leaves_nothing(ball_folder, tmp_path, capsys, monkeypatch):
    def log(self, row):
        assert self.previews()
        raise LumigraphError("metrics.jsonl could not be written because the disk is full; free some space")

    command = ["train", "voxel-grid", str(ball_folder), "--steps", "20", "--cells", "6", "--device", "cpu", "--output"]
    with monkeypatch.context() as patch:
        patch.setattr(Run, "log", log)
        assert main([*command, str(tmp_path / "run")]) == 2
    assert not (tmp_path / "run").exists()


def test_an_inferred_run_is_whole_or_not_there(ball_folder, tmp_path, capsys, monkeypatch):
    prior = prior_run(tmp_path / "prior")
    command = ["infer", str(prior.folder), str(ball_folder), "--views", "2", "--output"]

    def again(folder: Path) -> None:
        assert not folder.exists()
        assert main([*command, str(folder)]) == 0

    each_write(monkeypatch, lambda folder: failed(capsys, command, folder), again, tmp_path, step=4)


@pytest.mark.parametrize("name", ["plenoxels", "voxel-grid"])
def test_a_conversion_goes_on_after_any_write_that_failed(name, ball_run, tmp_path, monkeypatch):
    kind = methods.find(name)
    small = kind.Config(rays=64) if name == "voxel-grid" else kind.smallest()
    aim = ConvertOptions(steps=2, views=1)

    def work(folder: Path) -> int:
        try:
            convert(ball_run, name, folder, aim, config=small)
        except LumigraphError as fault:
            assert "because the disk is full" in str(fault)
            return 2
        return 0

    def again(folder: Path) -> None:
        assert convert(ball_run, name, folder, aim, config=small).steps == 2
        assert Converted.read(folder) is not None

    each_write(monkeypatch, work, again, tmp_path, step=4)


@pytest.mark.parametrize("command", ["convert", "compress", "train"])
def test_a_place_that_cannot_be_is_refused_before_the_work(
    command, ball_run, ball_folder, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(Run, "method", lambda self, device="cpu": pytest.fail("worked"))
    (tmp_path / "file").write_text("")
    told = {
        "convert": ["convert", str(ball_run.folder), "plenoxels"],
        "compress": ["compress", str(ball_run.folder)],
        "train": ["train", "voxel-grid", str(ball_folder)],
    }
    assert main([*told[command], "--output", str(tmp_path / "file" / "new")]) == 2
    assert "needs a folder where a file of that name lies" in capsys.readouterr().err
