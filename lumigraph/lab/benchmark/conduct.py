"""Train and evaluate the cells of a benchmark, each in a separate process, so that memory and faults are isolated;
update the table and charts after each."""

import contextlib
import os
import subprocess
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from ... import files, methods
from ...errors import LumigraphError
from ...evaluation.views import file_name
from ...figures import Row as Line
from ...figures import contact_sheet, save_picture
from ...figures.charts import line_chart, standalone
from ...files.locks import check_place, lock_folder
from ...metrics import scores_of
from ...readers.pictures import readable
from ...run import Run
from ...system.children import start_python
from ...system.progress import clock, counting
from ...system.signals import Interrupt
from .cell import SHEET, Cell, CellSettings, Row, claim, evaluation, read_rows, row_of, scored, training
from .table import markdown, over_time, over_views, places, resolution, together

Launch = Callable[[Sequence[str], Path], int]
STOP_CODES = (130, 143)  # after Ctrl-C and SIGTERM
PROMPT = b"$ lumigraph "  # each command in a log begins so
POLL_SECONDS = 0.2  # seconds between looks at whether to stop


def launch(arguments: Sequence[str], log: Path) -> int:
    """Run `lumigraph ARGUMENTS`, with its output appended to a log. Returns its exit code, as in shells. Loaded files
    of external methods are loaded there too.

    Ctrl-C and SIGTERM are forwarded, and the command saves its state and ends; also when this process is killed. It is
    detached from the terminal, which would send Ctrl-C a second time.
    """
    arguments = [*arguments, *(word for file in methods.loaded_here() for word in (methods.METHOD_FILE, file))]
    with files.explained(log):
        log.parent.mkdir(parents=True, exist_ok=True)
        out = open(log, "ab")
    with out, Interrupt() as interrupt:
        out.write(PROMPT + f"{' '.join(arguments)}\n".encode())
        out.flush()
        pipes: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": out, "stderr": out}
        words = ["-m", "lumigraph", *arguments]
        process = start_python(words, folder=Path.cwd(), start_new_session=True, **pipes)
        passed_on = False
        try:
            while process.poll() is None:
                if interrupt.signal and not passed_on and os.name != "nt":  # Windows signals both by itself
                    process.send_signal(interrupt.signal)
                    passed_on = True
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(POLL_SECONDS)
        finally:
            if process.poll() is None:  # a second Ctrl-C
                process.kill()
                process.wait()
    if interrupt.signal:
        return 128 + interrupt.signal  # even if the command was done just then
    return process.returncode if process.returncode >= 0 else 128 - process.returncode


def conduct(
    cells: Sequence[Cell],
    settings: CellSettings,
    output: Path,
    tell: Callable[[str], object] = print,
    launch: Launch = launch,
) -> int:
    """Train and evaluate all cells, and write results.json, results.md and pictures to `output`.

    Finished cells are kept, interrupted ones continue, failed ones are tried again. A failed cell is a row with the
    reason.
    tell: called with the title of the next cell. Returns the signal's exit code if one stopped it, otherwise 0.
    """
    check_place(output)
    for cell in cells:
        claim_log(log_of(cell, output))
    claim(output, cells, settings)
    with lock_folder(output, "worked in"):
        return carry_on(cells, settings, output, tell, launch)


def carry_on(
    cells: Sequence[Cell], settings: CellSettings, output: Path, tell: Callable[[str], object], launch: Launch
) -> int:
    """Process all cells, one after the other, in a locked folder."""
    rows, patience = read_rows(output), Patience()
    for number, cell in enumerate(cells, 1):
        halved = by_halves(rows)
        todo = [one for one in cells[number - 1 :] if unfinished(one, output, settings, halved)]
        if cell in todo:
            tell(f"{number} of {len(cells)}: {cell.title}; {patience.left(todo)}")
        begin = time.monotonic()
        with counting(cell.title):
            code, failure = carry_out(cell, output, settings, halved, launch)
        if code in STOP_CODES:
            return code
        if cell in todo and not failure:
            patience.note(cell, time.monotonic() - begin)
        if failure:
            tell(f"{cell.title} failed: {failure}")
        rows[f"runs/{cell.name}"] = row_of(cell, output, settings, failure)
        write(rows, output, settings)
    code = compare_alike(rows, output, settings, tell, launch)
    write(rows, output, settings)
    if code:
        return code
    found = list(rows.values())
    pictures = draw_charts(found, output) + draw_views(found, output)
    files.write_bytes(output / "results.md", markdown(found, pictures).encode(), "benchmark")
    return 0


def write(rows: dict[str, Row], output: Path, settings: CellSettings) -> None:
    """Write results.json, and results.md with the charts."""
    found = list(rows.values())
    files.write_json(output / "results.json", {"settings": settings.to_json(), "cells": found}, "benchmark")
    files.write_bytes(output / "results.md", markdown(found, draw_charts(found, output)).encode(), "benchmark")


def carry_out(
    cell: Cell, output: Path, settings: CellSettings, halved: set[str], launch: Launch
) -> tuple[int, str | None]:
    """Train and evaluate a cell unless finished. Returns the last exit code, and the reason of a failure."""
    folder, log = output / "runs" / cell.name, log_of(cell, output)
    for task in tasks(cell, folder, settings, halved):
        try:
            command = task()
        except LumigraphError as fault:
            return 2, str(fault)
        code = launch(command, log) if command else 0
        if code:
            return code, reason(log, code)
    return 0, None


def tasks(cell: Cell, folder: Path, settings: CellSettings, halved: set[str]) -> list[Callable[[], list[str]]]:
    """Functions that return the commands of a cell: its training, then its evaluation."""
    halves = (cell.collection or cell.scene) in halved
    return [partial(training, cell, folder, settings), partial(evaluation, folder, settings, halves)]


def by_halves(rows: dict[str, Row]) -> set[str]:
    """Scenes and collections with a cell evaluated on halves of photographs."""
    return {together(row) for row in rows.values() if not row["failed"] and row["protocol"].get("halves")}


def compare_alike(
    rows: dict[str, Row], output: Path, settings: CellSettings, tell: Callable[[str], object], launch: Launch
) -> int:
    """Evaluate cells again, those of earlier commands included, if their scene is now evaluated on halves, so that all
    methods of a scene are compared on the same pixels. Changes the rows. Returns the signal's exit code if one stopped
    it, otherwise 0."""
    halved = by_halves(rows)
    for name, row in rows.items():
        whole = not row["failed"] and "views" in row["protocol"] and not row["protocol"].get("halves")
        if not whole or together(row) not in halved:
            continue
        tell(f"{name} once more, on right halves, as other methods of {together(row)}")
        log = output / f"{name}.log"
        try:
            code = launch(evaluation(output / name, settings, True), log)
            if code in STOP_CODES:
                return code
            row |= {"failed": reason(log, code)} if code else scored(Run(output / name), settings)
        except LumigraphError as fault:
            row["failed"] = str(fault)
    return 0


def log_of(cell: Cell, output: Path) -> Path:
    return output / "runs" / f"{cell.name}.log"


def unfinished(cell: Cell, output: Path, settings: CellSettings, halved: set[str]) -> bool:
    try:
        return any(task() for task in tasks(cell, output / "runs" / cell.name, settings, halved))
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


def claim_log(log: Path) -> None:
    """Raise LumigraphError unless a log is new or a benchmark's."""
    with files.explained(log):
        if os.path.lexists(log) and (log.is_symlink() or log.read_bytes()[: len(PROMPT)] != PROMPT):
            raise LumigraphError(f"{log} is no log of a benchmark; move it away, or choose another --output")


def reason(log: Path, code: int) -> str:
    """Reason of a failed command: its last sentence in the log."""
    if code > 128:
        return f"ended by signal {code - 128}" + (", perhaps because memory was short" if code == 137 else "")
    lines = [line for line in log.read_text("utf-8", errors="replace").splitlines() if line.strip()]
    return lines[-1].removeprefix("lumigraph: ") if lines else f"exit code {code}"


def draw_charts(rows: Sequence[Row], output: Path) -> list[str]:
    """Draw all charts with at least two points. Returns the names of the files."""
    drawn = []
    for place, found in places([row for row in rows if not row["failed"]]):
        seconds = {row["budget"].get("seconds") for row in found if row["views"] is None}
        headline = scores_of(found[0])[0]
        for name, series, label, ticks in (
            ("time", over_time(found), "seconds of training", () if None in seconds else sorted(seconds)),
            ("views", over_views(found), "photographs to learn from", sorted({row["train_views"] for row in found})),
        ):
            if not any(len(one.x) > 1 for one in series):
                continue
            chart = line_chart(
                series,
                label,
                ", ".join(part for part in (f"held-out {headline.name}", headline.unit) if part),
                log_x=True,
                marks=True,
                smoothed=False,
                note=", ".join([*(one.name for one in series if len(series) == 1), place, resolution(found[0])]),
                x_ticks=ticks,
            )
            drawn.append(f"{place}-{headline.name.lower().replace(' ', '-')}-over-{name}.svg")
            files.write_bytes(output / drawn[-1], standalone(chart), "benchmark")
    return drawn


def draw_views(rows: Sequence[Row], output: Path) -> list[str]:
    """One held-out view of each scene, photographed and rendered by every method after its longest training."""
    measured = [row for row in rows if not row["failed"] and "shown" in row]
    best: dict[tuple[str, str, int], dict[str, Row]] = {}
    for row in sorted(measured, key=lambda row: (*row["budget"].values(), -row["seed"])):
        best.setdefault((row["scene"], row["shown"]["name"], row["train_views"]), {})[row["method"]] = row
    methods = sorted({method for cells in best.values() for method in cells})
    photographs: dict[tuple[str, str], Float[Tensor, "height width 3"]] = {}
    lines = []
    for (scene, name, views), cells in sorted(best.items()):
        if (scene, name) not in photographs:  # opening a scene takes a while
            opened = Run(output / next(iter(cells.values()))["run"]).scene()
            shot = opened.photograph(opened.names.index(name))
            photographs[scene, name] = shot.before(opened.frame.background)
        truth = photographs[scene, name]
        seen = [rendering(cells[method], output) if method in cells else torch.ones_like(truth) for method in methods]
        scores = [str(scores_of(cells[method]["shown"])[0]) if method in cells else "" for method in methods]
        lines.append(Line([f"{scene}, {views} views", *scores], [truth, *seen]))
    if not lines:
        return []
    save_picture(output / SHEET, contact_sheet("Held-out views", ["photograph", *methods], lines), "benchmark")
    return [SHEET]


def rendering(row: Row, output: Path) -> Float[Tensor, "height width 3"]:
    """A run's stored rendering of a view."""
    path = output / row["run"] / "eval" / f"{file_name(row['shown']['name'])}.png"
    with readable(path), Image.open(path) as image:
        return torch.from_numpy(np.array(image.convert("RGB"))).float() / 255
