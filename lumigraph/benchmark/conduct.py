"""From cells to results: what is still to be done about each, in a process of its own, and the table after each."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from .. import files
from ..errors import LumigraphError
from ..files.locks import check_place, held
from ..system.progress import clock, counting
from .cell import Cell, Settings, claim, evaluation, training
from .launch import STOP_CODES, Launch, claim_log, launch, reason
from .pictures import draw_charts, draw_views
from .results import read_rows, row_of
from .table import markdown


def conduct(
    cells: Sequence[Cell],
    settings: Settings,
    output: Path,
    tell: Callable[[str], object] = print,
    launch: Launch = launch,
) -> int:
    """Train and evaluate all cells, and write results.json, results.md and pictures to `output`.

    Cells that are done are kept, half-trained ones go on, failed ones are tried again. A cell that fails is a row that
    says why. tell: hears which cell is next. Returns the signal's exit code if one stopped it, otherwise 0.
    """
    check_place(output)
    for cell in cells:
        claim_log(log_of(cell, output))
    claim(output, cells, settings)
    with held(output, "worked in"):
        return carry_on(cells, settings, output, tell, launch)


def carry_on(
    cells: Sequence[Cell], settings: Settings, output: Path, tell: Callable[[str], object], launch: Launch
) -> int:
    """All cells, one after the other, in a folder that is ours alone."""
    rows, patience = read_rows(output), Patience()
    for number, cell in enumerate(cells, 1):
        todo = [one for one in cells[number - 1 :] if unfinished(one, output, settings)]
        if cell in todo:
            tell(f"{number} of {len(cells)}: {cell.title}; {patience.left(todo)}")
        begin = time.monotonic()
        with counting(cell.title):
            code, failure = carry_out(cell, output, settings, launch)
        if code in STOP_CODES:
            return code
        if cell in todo and not failure:
            patience.note(cell, time.monotonic() - begin)
        if failure:
            tell(f"{cell.title} failed: {failure}")
        rows[f"runs/{cell.name}"] = row_of(cell, output, settings, failure)
        found = list(rows.values())
        files.write_json(output / "results.json", {"settings": settings.to_json(), "cells": found}, "benchmark")
        files.write_bytes(output / "results.md", markdown(found, draw_charts(found, output)).encode(), "benchmark")
    found = list(rows.values())
    pictures = draw_charts(found, output) + draw_views(found, output)
    files.write_bytes(output / "results.md", markdown(found, pictures).encode(), "benchmark")
    return 0


def carry_out(cell: Cell, output: Path, settings: Settings, launch: Launch) -> tuple[int, str | None]:
    """Train and evaluate a cell as far as that is not done. Returns the last exit code, and why it failed if it did."""
    folder, log = output / "runs" / cell.name, log_of(cell, output)
    for task in (training, evaluation):
        try:
            command = task(cell, folder, settings)
        except LumigraphError as fault:
            return 2, str(fault)
        code = launch(command, log) if command else 0
        if code:
            return code, reason(log, code)
    return 0, None


def log_of(cell: Cell, output: Path) -> Path:
    return output / "runs" / f"{cell.name}.log"


def unfinished(cell: Cell, output: Path, settings: Settings) -> bool:
    folder = output / "runs" / cell.name
    try:
        return bool(training(cell, folder, settings) or evaluation(cell, folder, settings))
    except LumigraphError:  # a damaged run, which the cell's row will tell
        return True


class Patience:
    """Estimate of the remaining time, from the overhead of past cells beyond their training seconds."""

    def __init__(self) -> None:
        self.needed: list[float] = []

    def note(self, cell: Cell, seconds: float) -> None:
        self.needed.append(seconds - cell.seconds)

    def left(self, todo: Sequence[Cell]) -> str:
        beside = sum(self.needed) / len(self.needed) if self.needed else 0.0
        seconds = sum(cell.seconds + beside for cell in todo)
        return f"{'about' if self.needed else 'at least'} {clock(max(seconds, 0))} left"
