"""Progress of long work on stderr: a bar on a terminal, plain lines in a log; short numbers and times."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from .console import console, is_live

BAR_DELAY = 1.0  # seconds before a bar appears
FIRST_LINE_SECONDS = 3.0  # until the first line in a log
INTERVAL_GROWTH = 1.5  # factor from one interval between lines to the next
MAX_INTERVAL = 60.0  # seconds between two lines

T = TypeVar("T")
Listener = Callable[[str, int, int | None], object]  # of a stage's description, items done, all of them if known
_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


@contextmanager
def heard_by(listener: Listener | None) -> Iterator[None]:
    """A block in which a function hears of each stage and of each step of training.

    What it raises ends the work, and true as its result does by KeyboardInterrupt. No file is left half written.
    """
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def report(description: str, count: int, total: int | None) -> None:
    """Tell the listener of the block, if there is one. Raises KeyboardInterrupt if it ends the work."""
    if (listener := _listener.get()) is not None and listener(description, count, total):
        raise KeyboardInterrupt


def track(items: Iterable[T], description: str, total: int) -> Iterator[T]:
    """The items one by one, with a progress bar after a moment."""
    with counting(description, total) as done:
        for number, item in enumerate(items, 1):
            yield item
            done(number)


@contextmanager
def counting(description: str, total: int | None = None) -> Iterator[Callable[[int], None]]:
    """Callback for the number of finished items out of `total`; None for an unknown total.

    Progress is shown after a moment: as a bar on a terminal, in a log as an occasional line. Nested stages are not
    shown.
    """
    stage = ProgressStage(description, total)
    try:
        stage.done(0)
        yield stage.done
    except BaseException:
        stage.end(well=False)
        raise
    stage.end(well=True)


class ProgressStage:
    """A stage of work with progress display from a thread of its own, which also covers a slow first item."""

    _shown: ProgressStage | None = None  # one at a time

    def __init__(self, description: str, total: int | None):
        self.description, self.total, self.count = description, total, 0
        self._begin, self._over, self._told = time.monotonic(), threading.Event(), False
        self._watcher = threading.Thread(target=self._watch, name="progress", daemon=True)
        if ProgressStage._shown is None:
            ProgressStage._shown = self
            self._watcher.start()

    def done(self, count: int) -> None:
        self.count = count
        report(self.description, count, self.total)

    def end(self, well: bool) -> None:
        """End the display. well: whether the work was completed"""
        if ProgressStage._shown is not self:
            return
        ProgressStage._shown = None
        self._over.set()
        self._watcher.join()
        if self._told and well:
            tell(f"{self.description}: took {clock(self.seconds)}")

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._begin

    def _watch(self) -> None:
        if is_live():
            if not self._over.wait(BAR_DELAY):
                self._draw()
            return
        pause = FIRST_LINE_SECONDS
        while not self._over.wait(pause):
            tell(self.line())
            self._told, pause = True, min(INTERVAL_GROWTH * pause, MAX_INTERVAL)

    def _draw(self) -> None:
        """Draw a bar until the work ends."""
        counts = (BarColumn(24), MofNCompleteColumn(), TimeRemainingColumn(True))
        columns = counts if self.total else (TimeElapsedColumn(),)
        name = TextColumn("{task.description}", "bold", markup=False)
        with Progress(name, *columns, console=console(True), transient=True) as bar:
            task = bar.add_task(self.description, total=self.total, completed=self.count)
            while not self._over.wait(0.1):
                bar.update(task, completed=self.count)

    def line(self) -> str:
        """Line of a log: count, share, remaining time."""
        if self.total is None:
            return f"{self.description}: {clock(self.seconds)} so far"
        told = f"{self.description}: {self.count} of {self.total}"
        if not self.count or not self.total:
            return f"{told}, {clock(self.seconds)} so far"
        left = self.seconds * (self.total - self.count) / self.count
        return f"{told}, {100 * self.count / self.total:.0f} %, about {clock(left)} left"


class NumberedStages:
    """Stages of long work, each announced on stderr as it begins: "2 of 3: train"; silent unless shown."""

    def __init__(self, names: Sequence[str], time: str, show: bool):
        self._names, self._next, self._show = names, 0, show
        self._tell(f"{len(names)} stages{time}: {', '.join(names)}")

    def begin(self) -> None:
        """Announce the next stage."""
        self._next += 1
        self._tell(f"{self._next} of {len(self._names)}: {self._names[self._next - 1]}")

    def _tell(self, line: str) -> None:
        if self._show:
            tell(line)


def tell(line: str) -> None:
    """Write a line to stderr."""
    print(line, file=sys.stderr, flush=True)


def short(number: float) -> str:
    """Number with three digits and an SI prefix: 1 234 567 is 1.23 M."""
    for size, prefix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if number >= size:
            return f"{number / size:.3g}{prefix}"
    return f"{number:.3g}"


def clock(seconds: float) -> str:
    """Seconds as a clock time: 90 is 1:30."""
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
