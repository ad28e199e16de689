"""What a person sees of training: a bar on a terminal, plain lines elsewhere, on stderr."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn

from .method import Lesson
from .progress import clock, short

REFRESH = 0.5  # seconds between looks at a bar
LINES = 10.0  # seconds between lines where there is no terminal
MEMORY = 0.8  # share of the smoothed error that one look keeps


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
        self._count = 0  # of what was learnt from, since then
        self._unit = ""  # what these are
        self._loss: float | None = None
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

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Inside this block the bar makes room for that of a stage ahead of the first step."""
        if self._live:
            self.bar.stop()
        yield
        if self._live:
            self.bar.start()

    def say(self, text: str) -> None:
        """What is going on, ahead of the first step."""
        self.bar.update(self.task, description=text)
        self._print(text)

    @property
    def due(self) -> bool:
        """Whether the next step's figures are to be shown."""
        return time.perf_counter() >= self._next

    def update(self, step: int, seconds: float, progress: float, batch: Lesson, row: dict[str, Any]) -> None:
        """Note a step and what it learnt from. row: its figures, empty for most steps."""
        self._count += len(batch)
        self._unit = batch.unit
        if not row:
            return
        if "psnr" in row:
            mse = 10 ** (-row["psnr"] / 10)
            self.error = mse if self.error is None else MEMORY * self.error + (1 - MEMORY) * mse
        self._loss = row.get("loss")
        if self.due:
            self._look(step, seconds, progress, row["statistics"])
            self._next = time.perf_counter() + (REFRESH if self._live else LINES)

    def _quality(self) -> list[str]:
        """The PSNR of what was learnt from; the loss, of methods that have none."""
        if self.error is not None:
            return [f"{-10 * math.log10(max(self.error, 1e-10)):.2f} dB"]
        return [] if self._loss is None else [f"loss {short(self._loss)}"]

    def _look(self, step: int, seconds: float, progress: float, statistics: dict[str, float]) -> None:
        parts = [f"step {step}", *self._quality()]
        if self._seen and seconds > self._seen[1]:
            rate = 1 / (seconds - self._seen[1])
            if "samples" in statistics:
                parts.append(f"{short(statistics['samples'] * (step - self._seen[0]) * rate)} samples/s")
            parts.append(f"{short(self._count * rate)} {self._unit}/s")
        if progress > 0.02:  # before that nobody can tell
            parts.append(f"{clock(seconds * (1 - progress) / progress)} left")
        self._seen, self._count = (step, seconds), 0
        figures = " · ".join(parts)
        self.bar.update(self.task, description="Training", completed=progress, figures=figures)
        self._print(f"{100 * progress:3.0f} %  {figures}")

    def done(self, step: int, seconds: float, progress: float) -> None:
        """The last word."""
        figures = " · ".join([f"step {step}", *self._quality(), f"{clock(seconds)} trained"])
        self.bar.update(self.task, completed=progress, figures=figures)
        self._print(f"{100 * progress:3.0f} %  {figures}")

    def _print(self, line: str) -> None:
        if self.show and not self.terminal and line:
            print(line, file=sys.stderr, flush=True)
