"""Progress of all blocks: one display for the terminal, and a file in the run's folder.

Both are read from the blocks' own folders, so that workers on other machines need not report.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from rich.progress import BarColumn, Progress, TextColumn

from .. import files
from ..budget import Budget
from ..errors import LumigraphError
from ..system.console import console, is_live
from ..system.progress import clock, tell
from .plan import DONE_FILE

POLL_SECONDS = 1.0  # seconds between looks
TAIL_BYTES = 4096  # at a log's end, which contain its last line
# Seconds until the first line of a log; growth of the interval between lines; its upper limit in seconds.
FIRST_LINE_SECONDS, INTERVAL_GROWTH, MAX_INTERVAL = 10.0, 1.5, 60.0
PROGRESS_FILE = "progress.json"


@dataclass(frozen=True)
class Stand:
    """Progress of one block: the share of its budget, seconds of training, and the PSNR of its training photographs."""

    state: str = "waiting"
    share: float = 0.0
    seconds: float = 0.0
    psnr: float | None = None


def stand_of(folder: Path) -> Stand:
    """Progress of a block, read from its folder."""
    try:
        row = last_line(folder / "metrics.jsonl")
        if (folder / DONE_FILE).exists():
            return Stand("done", 1.0, float(row.get("seconds", 0.0)), row.get("psnr"))
        if not (folder / "config.json").exists():
            return Stand()
        budget = Budget.from_json(files.read_json(folder / "config.json")["budget"])
        if not row:
            return Stand("beginning")
        share = budget.progress(int(row["step"]), float(row["seconds"]))
        return Stand("learning", share, float(row["seconds"]), row.get("psnr"))
    except (LumigraphError, LookupError, TypeError, ValueError):  # it is being written
        return Stand("beginning")


def last_line(path: Path) -> dict[str, Any]:
    """The last complete line of a run's metrics; {} without one."""
    try:
        with open(path, "rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - TAIL_BYTES))
            lines = file.read().split(b"\n")[:-1]
    except OSError:
        return {}
    for line in reversed(lines):
        try:
            row = json.loads(line)
        except ValueError:
            continue
        return row if isinstance(row, dict) else {}
    return {}


class Watching:
    """Context that displays the progress of all blocks. folders: of the blocks, by name"""

    def __init__(self, run: Path, folders: dict[str, Path], show: bool = True):
        self.run, self.folders, self.show = run, folders, show
        self.stands: dict[str, Stand] = {name: Stand() for name in folders}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="blocks", daemon=True)
        self._begin = time.monotonic()

    def __enter__(self) -> Watching:
        self.look()
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, at: TracebackType | None) -> None:
        self._over.set()
        self._thread.join()
        self.look()
        self.note()

    def look(self) -> list[str]:
        """Update unfinished blocks; returns the names of newly finished ones."""
        new = []
        for name, folder in self.folders.items():
            if self.stands[name].state != "done":
                self.stands[name] = stand_of(folder)
                new += [name] if self.stands[name].state == "done" else []
        return new

    def note(self) -> None:
        """Write the progress of all blocks to the run's folder, for other processes."""
        stands = {name: asdict(stand) for name, stand in self.stands.items()}
        files.write_json(self.run / PROGRESS_FILE, stands, ours=True)

    @property
    def share(self) -> float:
        return sum(stand.share for stand in self.stands.values()) / max(len(self.stands), 1)

    def line(self) -> str:
        """All blocks in one line."""
        stands = self.stands.values()
        done = sum(stand.state == "done" for stand in stands)
        busy = [f"{name} {100 * x.share:.0f} %" for name, x in self.stands.items() if x.state == "learning"]
        told = f"{100 * self.share:3.0f} %  {done} of {len(stands)} blocks done"
        return " · ".join([told, f"{clock(time.monotonic() - self._begin)} so far", *busy[:8]])

    def _watch(self) -> None:
        if self.show and is_live():
            self._draw()
            return
        pause, due = FIRST_LINE_SECONDS, time.monotonic() + FIRST_LINE_SECONDS
        while not self._over.wait(POLL_SECONDS):
            for name in self.look():
                if self.show:
                    tell(f"block {name} is done: {described(self.stands[name])}")
            if time.monotonic() >= due:
                if self.show:
                    tell(self.line())
                self.note()
                pause = min(INTERVAL_GROWTH * pause, MAX_INTERVAL)
                due = time.monotonic() + pause

    def _draw(self) -> None:
        columns = TextColumn("{task.description}", "bold", markup=False), BarColumn(24)
        with Progress(*columns, TextColumn("{task.fields[told]}", markup=False), console=console(True)) as bars:
            rows = {name: bars.add_task(f"block {name}", total=1.0, told="waiting") for name in self.folders}
            noted = time.monotonic()
            while True:
                over = self._over.wait(POLL_SECONDS)
                self.look()
                for name, row in rows.items():
                    bars.update(row, completed=self.stands[name].share, told=described(self.stands[name]))
                if time.monotonic() - noted > FIRST_LINE_SECONDS:
                    self.note()
                    noted = time.monotonic()
                if over:
                    return


def described(stand: Stand) -> str:
    """Progress in a few words."""
    if stand.state in ("waiting", "beginning"):
        return stand.state
    parts = [f"{100 * stand.share:3.0f} %", f"{clock(stand.seconds)} trained"]
    return " · ".join(parts + ([] if stand.psnr is None else [f"PSNR {stand.psnr:.1f} dB"]))


def in_order(folders: dict[str, Path]) -> Sequence[str]:
    """Names of blocks, those in progress first, so that few are half-done at any time."""
    return sorted(folders, key=lambda name: (not (folders[name] / "config.json").exists(), int(name)))
