"""What the person sees while a machine works: bars on a terminal, plain lines elsewhere. All of it on stderr."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn
from torch import Tensor

from .method import Method
from .scene import Batch, Photograph

REFRESH = 0.5  # seconds between looks at a bar
LINES = 10.0  # seconds between lines where there is no terminal
MEMORY = 0.8  # share of the smoothed error that one look keeps

T = TypeVar("T")


class TrainingDisplay:
    """Live PSNR, speed and time left. PSNR is that of training batches, smoothed; it says little of held-out views."""

    def __init__(self, show: bool = True):
        self.console = Console(stderr=True)
        self.show, self.terminal = show, self.console.is_terminal
        columns = (
            SpinnerColumn(), TextColumn("[bold]{task.description}"), BarColumn(24),
            TextColumn("{task.percentage:>3.0f} %"), TextColumn("{task.fields[figures]}"),
        )  # fmt: skip
        self.bar = Progress(*columns, console=self.console, refresh_per_second=1 / REFRESH)
        self.task = self.bar.add_task("Starting", total=1.0, figures="")
        self.error: float | None = None  # smoothed squared error
        self._seen: tuple[int, float] | None = None  # step and seconds at the last look
        self._rays = 0  # since then
        self._next = 0.0

    @property
    def _live(self) -> bool:
        return self.show and self.terminal

    def __enter__(self) -> TrainingDisplay:
        if self._live:
            self.bar.start()
        return self

    def __exit__(self, *fault: object) -> None:
        if self._live:
            self.bar.stop()

    def say(self, text: str) -> None:
        """What is going on, ahead of the first step."""
        self.bar.update(self.task, description=text)
        self._print(text)

    def update(
        self,
        step: int,
        seconds: float,
        progress: float,
        batch: Batch | Photograph,
        terms: dict[str, Tensor],
        method: Method,
        needed: bool,
    ) -> dict[str, Any]:
        """Note a step. Gives its figures if they are needed; otherwise it may skip finding them, which is cheaper."""
        self._rays += len(batch)
        now = time.perf_counter()
        due = now >= self._next
        if not (needed or due):
            return {}
        statistics = {name: float(value) for name, value in method.statistics().items()}
        losses = {name: value.item() for name, value in terms.items()}
        mse = squared_error(statistics, losses)
        self.error = mse if self.error is None else MEMORY * self.error + (1 - MEMORY) * mse
        row = {
            "step": step,
            "seconds": round(seconds, 4),
            "loss": sum(losses.values()),
            "terms": losses,
            "psnr": decibels(mse),
            "statistics": statistics,
        }
        if due:
            self._look(step, seconds, progress, statistics)
            self._next = now + (REFRESH if self._live else LINES)
        return row

    def _look(self, step: int, seconds: float, progress: float, statistics: dict[str, float]) -> None:
        parts = [f"step {step}", f"{decibels(self.error or 0):.2f} dB"]
        if self._seen and seconds > self._seen[1]:
            rate = 1 / (seconds - self._seen[1])
            if "samples" in statistics:
                parts.append(f"{short(statistics['samples'] * (step - self._seen[0]) * rate)} samples/s")
            parts.append(f"{short(self._rays * rate)} rays/s")
        if progress > 0.02:  # before that nobody can tell
            parts.append(f"{clock(seconds * (1 - progress) / progress)} left")
        self._seen, self._rays = (step, seconds), 0
        figures = " · ".join(parts)
        self.bar.update(self.task, description="Training", completed=progress, figures=figures)
        self._print(f"{100 * progress:3.0f} %  {figures}")

    def done(self, step: int, seconds: float, progress: float) -> None:
        """The last word."""
        error = f" · {decibels(self.error):.2f} dB" if self.error is not None else ""
        figures = f"step {step}{error} · {clock(seconds)} trained"
        self.bar.update(self.task, completed=progress, figures=figures)
        self._print(f"{100 * progress:3.0f} %  {figures}")

    def _print(self, line: str) -> None:
        if self.show and not self.terminal and line:
            print(line, file=sys.stderr, flush=True)


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


def squared_error(statistics: dict[str, float], losses: dict[str, float]) -> float:
    """Of a training step: as the method reports it, otherwise taking its loss for it."""
    if "mse" in statistics:
        return statistics["mse"]
    if "psnr" in statistics:
        return 10 ** (-statistics["psnr"] / 10)
    return sum(losses.values())


def decibels(mse: float) -> float:
    return -10 * math.log10(max(mse, 1e-10))


def short(number: float) -> str:
    """Three digits and a prefix: 1 234 567 is 1.23 M."""
    for size, prefix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if number >= size:
            return f"{number / size:.3g}{prefix}"
    return f"{number:.3g}"


def clock(seconds: float) -> str:
    """90 is 1:30."""
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
