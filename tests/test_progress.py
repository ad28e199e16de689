"""What is seen of long work: plain lines in a log, a bar on a terminal, names as they are."""

from __future__ import annotations

import io
import re
import sys
import time

import pytest
from budgets import budget
from rich.tree import Tree

from lumigraph.commands.common import show
from lumigraph.system import progress
from lumigraph.system.console import bold, console
from lumigraph.system.progress import ProgressStage, counting, track

pytestmark = budget("runs")

NAMES = ["[/bold]", "[red]a[/red]", ":smile: {0} {task}", "a 'quoted' \"name\"", "[link=file:///etc]x[/link]"]


@pytest.fixture
def hurried(monkeypatch):
    """Lines come a hundred times as often."""
    monkeypatch.setattr(progress, "FIRST_LINE_SECONDS", 0.03)
    monkeypatch.setattr(progress, "BAR_DELAY", 0.03)


def test_a_log_hears_of_work_before_its_first_item_is_done(hurried, capsys):
    for _ in track(range(2), "Comparing [views] {x}", 2):
        time.sleep(0.25)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "Comparing [views] {x}: 0 of 2, 0:00 so far"
    assert re.fullmatch(r"Comparing \[views\] \{x\}: 1 of 2, 50 %, about 0:0\d left", lines[-2])
    assert lines[-1] == "Comparing [views] {x}: took 0:00"
    assert 4 <= len(lines) <= 12  # ever more rarely


def test_work_of_a_moment_is_not_told_of(capsys):
    assert list(track("abc", "Filming", 3)) == ["a", "b", "c"]
    assert not capsys.readouterr().err


def test_where_nobody_knows_how_much_there_is(hurried, capsys):
    with counting("Smoothing"):
        time.sleep(0.1)
    assert capsys.readouterr().err.splitlines()[0] == "Smoothing: 0:00 so far"


def test_a_stage_within_another_is_not_shown_and_a_fault_is_not_called_done(hurried, capsys):
    with pytest.raises(ValueError), counting("Outer", 3):
        with counting("Inner"):
            time.sleep(0.1)
        raise ValueError
    lines = capsys.readouterr().err.splitlines()
    assert lines and set(lines) == {"Outer: 0 of 3, 0:00 so far"} and ProgressStage._shown is None


def test_lines_come_soon_and_then_rarely():
    when, pause, seconds = [], progress.FIRST_LINE_SECONDS, 0.0
    while seconds < 3600:
        seconds += pause
        when.append(seconds)
        pause = min(progress.INTERVAL_GROWTH * pause, progress.MAX_INTERVAL)
    assert when[0] < 5 and len(when) < 80


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("name", NAMES)
def test_names_are_printed_as_they_are(name, hurried, capsys, monkeypatch):
    show({"film": name, "headline": bold(name) + " dB"})
    tree = Tree(bold(name) + "  a scene")
    tree.add(name)
    console(width=200).print(tree)
    told = capsys.readouterr().out
    assert told.splitlines()[0] == f"film      {name}" and told.count(name) == 4
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with counting(f"Filming {name}", 3) as done:
        done(1)
        deadline = time.monotonic() + 20
        while "1/3" not in terminal.getvalue():
            assert time.monotonic() < deadline
            time.sleep(0.02)
    assert f"Filming {name}" in re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", terminal.getvalue())


def test_colours_that_a_log_is_told_to_have_make_no_terminal_of_it(hurried, capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    with counting("Filming", 3):
        time.sleep(0.1)
    told = capsys.readouterr().err
    assert told.startswith("Filming: 0 of 3, ") and "\x1b" not in told
