"""Who works in a folder: one process at a time, told by name, and a killed one no longer."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import tiny
from budgets import budget
from shape_checks import PACKAGE

from lumigraph.commands.cli import main
from lumigraph.errors import LumigraphError
from lumigraph.files import locks
from lumigraph.files.locks import lock_folder
from lumigraph.run import Run
from lumigraph.sfm.reconstruction import reconstruct
from lumigraph.training import fit

pytestmark = budget("runs")

HOLDER = """
import sys
from pathlib import Path
from lumigraph.files.locks import lock_folder
with lock_folder(Path(sys.argv[1]), "trained"):
    print("held", flush=True)
    sys.stdin.read()
"""


@contextlib.contextmanager
def somebody(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds a folder until the block ends."""
    command = [sys.executable, "-c", HOLDER, str(folder)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    environment = os.environ | {"PYTHONPATH": str(PACKAGE.parent)}
    with subprocess.Popen(command, env=environment, text=True, **pipes) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.stdin.close()


def test_a_second_one_hears_who_is_at_work(tmp_path):
    with somebody(tmp_path) as other:
        with pytest.raises(LumigraphError) as told, lock_folder(tmp_path, "trained"):
            pass
        who = rf"{tmp_path} is being trained by process {other.pid} on \S+ since \d{{4}}-\d\d-\d\d \d\d:\d\d:\d\d; wait"
        assert re.match(who, str(told.value))
    with lock_folder(tmp_path, "trained"), lock_folder(tmp_path, "trained"):
        assert [path.name for path in tmp_path.iterdir()] == [locks.LOCK_FILE]
    assert not list(tmp_path.iterdir())


def test_what_a_killed_process_left_is_taken_over(tmp_path):
    with somebody(tmp_path) as other:
        other.kill()
        other.wait()
        assert (tmp_path / locks.LOCK_FILE).exists()
        with lock_folder(tmp_path, "trained"):
            assert str(os.getpid()) in (tmp_path / locks.LOCK_FILE).read_text()


def test_a_run_is_trained_by_one_process_at_a_time(tmp_path, capsys):
    run = tiny.new_run(tmp_path / "run")
    with somebody(run.folder):
        before = sorted(path.name for path in run.folder.rglob("*"))
        with pytest.raises(LumigraphError, match="is being trained by process"):
            fit(run.new_method(), tiny.scene(), run, steps=5, show=False, rehearsal=False)
        assert main(["resume", str(run.folder), "--steps", "7"]) == 2
        assert "is being trained by process" in capsys.readouterr().err
        assert sorted(path.name for path in run.folder.rglob("*")) == before
        assert run.method_name == Run(run.folder).method_name  # whoever only looks may
    assert fit(run.new_method(), tiny.scene(), run, steps=5, show=False, rehearsal=False).finished


def test_a_run_begins_where_only_a_dead_lock_lies(tmp_path):
    (tmp_path / locks.LOCK_FILE).write_text('{"process": 4')
    assert tiny.new_run(tmp_path).folder == tmp_path


def test_two_captures_into_one_folder(tmp_path):
    photographs, scene = tmp_path / "photographs", tmp_path / "scene"
    photographs.mkdir()
    (scene / "work").mkdir(parents=True)
    (scene / "work" / "sources.json").write_text(f'["{photographs.resolve()}"]')
    with somebody(scene / "work"), pytest.raises(LumigraphError, match="is being worked in by process"):
        reconstruct([photographs], scene)
