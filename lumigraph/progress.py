"""Progress of long work on stderr: bars on a terminal, plain lines elsewhere; numbers and times in few digits."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

PATIENCE = 1.0  # seconds before a bar appears

T = TypeVar("T")


def track(items: Iterable[T], description: str, total: int) -> Iterator[T]:
    """The items one by one, with a bar on a terminal."""
    console = Console(stderr=True)
    if not console.is_terminal:
        print(f"{description} ({total})", file=sys.stderr, flush=True)
        yield from items
        return
    columns = (TextColumn("[bold]{task.description}"), BarColumn(24), MofNCompleteColumn(), TimeRemainingColumn(True))
    with Progress(*columns, console=console, transient=True) as bar:
        yield from bar.track(items, total=total, description=description)


@contextmanager
def counting(label: str, total: int) -> Iterator[Callable[[int], None]]:
    """A function to be told how many of `total` are done; a bar appears on a terminal once the work takes a second."""
    console = Console(stderr=True)
    columns = (TextColumn(label), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=console, transient=True)
    task, begin = bar.add_task(label, total=total), time.monotonic()

    def done(count: int) -> None:
        if console.is_terminal and not bar.live.is_started and time.monotonic() - begin > PATIENCE:
            bar.start()
        bar.update(task, completed=count)

    try:
        yield done
    finally:
        if bar.live.is_started:  # otherwise stop() would print an empty line
            bar.stop()


def short(number: float) -> str:
    """Three digits and a prefix: 1 234 567 is 1.23 M."""
    for size, prefix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if number >= size:
            return f"{number / size:.3g}{prefix}"
    return f"{number:.3g}"


def clock(seconds: float) -> str:
    """90 is 1:30."""
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
