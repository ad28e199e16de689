"""Progress of training on stderr: an announcement, then a bar on a terminal or plain lines elsewhere."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Int
from rich.console import RenderableType
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn
from rich.text import Text
from torch import Tensor

from ..budget import Budget, lasting
from ..datasets.dataset import Dataset
from ..datasets.scene import Scene
from ..datasets.words import Words
from ..method import Lesson, Method
from ..method.capabilities import HasGaussians, can
from ..system import threads
from ..system.console import console, is_live
from ..system.progress import clock, short, tell

REFRESH = 0.5  # seconds between looks at a bar
FIRST_LINE_SECONDS = 3.0  # seconds to the first line with a time left
LINE_INTERVALS = 10.0, 60.0  # seconds between lines where there is no terminal: at least, and later at most
LINE_SHARE = 0.1  # of the time so far that passes between lines, within these limits
SMOOTHING = 0.8  # share of the smoothed PSNR that another value leaves
OMITTED_STATISTICS = {"mse", "rays", "samples", "visible_samples", "reduction"}  # statistics, as PSNR and by the second
NAMES = {"gaussians": "Gaussians"}  # of statistics, for people


class Bar(Progress):
    """A progress bar with a line of figures below it."""

    figures = ""

    def get_renderables(self) -> Iterable[RenderableType]:
        yield self.make_tasks_table(self.tasks)
        if self.figures:
            yield Text(f"  {self.figures}", style="dim")


class TrainingDisplay:
    """Display of training: data, then progress, size of the method and remaining time.

    PSNR is that of the training photographs, smoothed; it says little about held-out ones.
    """

    def __init__(self, show: bool = True):
        self.console = console(True)
        self.show, self.terminal = show, is_live()
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description}", "bold", markup=False),
            BarColumn(24),
            TextColumn("{task.fields[told]}", markup=False),
        )
        self.bar = Bar(*columns, console=self.console, refresh_per_second=1 / REFRESH)
        self.task = self.bar.add_task("Starting", total=1.0, told="")
        self.psnr: float | None = None  # smoothed
        self._begun: tuple[int, float] | None = None  # step and seconds at which this sitting began
        self._seen: tuple[int, float] | None = None  # step and seconds at the last look
        self._count = 0  # of what was learnt from, since then
        self._unit = ""  # what these are
        self._loss: float | None = None
        self._reduction = 1.0  # of photographs, at the last look
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
        """Block in which the bar is hidden for that of a stage before the first step."""
        if not self._live:
            yield
            return
        self.bar.live.transient = True
        self.bar.stop()
        yield
        self.bar.live.transient = False
        self.bar.start()

    def begin(self, data: Dataset, memory: str) -> None:
        """Show the training data, the sentence about memory, and that kernels are compiled before the first step."""
        self._line(learnt_from(data))
        self._line(memory)
        self.bar.update(self.task, description="Compiling kernels")
        if not self.terminal:
            self._line("Compiling kernels, which takes long the first time only")

    def ready(self, name: str, method: Method, budget: Budget, step: int, seconds: float) -> None:
        """Show the method, the machine and the budget."""
        self._line(f"{learner(name, method)}, {machine(method.device)}, {how_long(budget, step, seconds)}")
        self.bar.update(self.task, description="Training", completed=budget.progress(step, seconds))
        self._begun = self._seen = step, seconds
        self._next = time.perf_counter() + (REFRESH if self._live else FIRST_LINE_SECONDS)

    @property
    def due(self) -> bool:
        """True if the next step's figures are due."""
        return time.perf_counter() >= self._next

    def update(self, step: int, seconds: float, budget: Budget, batch: Lesson, row: dict[str, Any]) -> None:
        """Record a step and its batch. row: its figures, empty for most steps"""
        self._count += len(batch)
        self._unit = batch.unit
        if not row:
            return
        before, self._reduction = self._reduction, row["statistics"].get("reduction", 1.0)
        if self._reduction < before:
            self.psnr = None
            size = "full size" if self._reduction == 1 else f"1/{self._reduction:.0f} of their size"
            self._line(f"Photographs are at {size} from step {step:,} on; sharper ones have a lower PSNR at first")
        if "psnr" in row:
            now = row["psnr"]
            self.psnr = now if self.psnr is None else SMOOTHING * self.psnr + (1 - SMOOTHING) * now
        self._loss = row.get("loss")
        if self.due:
            self._look(step, seconds, budget, row["statistics"])
            least, most = LINE_INTERVALS
            self._next = time.perf_counter() + (REFRESH if self._live else min(max(LINE_SHARE * seconds, least), most))

    def _quality(self) -> list[str]:
        """PSNR of the training batches; the loss for methods without one."""
        if self.psnr is not None:
            return [f"PSNR of training photographs {self.psnr:.2f} dB"]
        return [] if self._loss is None else [f"loss {short(self._loss)}"]

    def _look(self, step: int, seconds: float, budget: Budget, statistics: dict[str, float]) -> None:
        assert self._begun is not None and self._seen is not None
        parts = [f"step {step:,}", *sizes(statistics), *self._quality()]
        if seconds > self._seen[1]:
            rate = 1 / (seconds - self._seen[1])
            if "samples" in statistics:
                parts.append(f"{short(statistics['samples'] * (step - self._seen[0]) * rate)} samples/s")
            parts.append(f"{short(self._count * rate)} {self._unit}/s")
        self._seen, self._count = (step, seconds), 0
        left = time_left(budget, step, seconds, self._begun)
        self._show(budget.progress(step, seconds), f"about {clock(left)} left", parts)

    def done(self, step: int, seconds: float, progress: float) -> None:
        """Show the final line."""
        self._show(progress, f"{clock(seconds)} trained", [f"step {step:,}", *self._quality()])

    def _show(self, progress: float, time: str, parts: list[str]) -> None:
        share, self.bar.figures = f"{100 * progress:3.0f} %", " · ".join(parts)
        self.bar.update(self.task, completed=progress, told=f"{share} · {time}")
        if not self.terminal:
            self._line(" · ".join([f"{share}  {time}", *parts]))

    def _line(self, line: str) -> None:
        """Print a permanent line; on a terminal, above the bar."""
        if self._live:
            self.console.print(line, soft_wrap=True)
        elif self.show:
            tell(line)


def sizes(statistics: dict[str, float]) -> list[str]:
    """Statistics of a method: whole numbers as counts, others unchanged."""
    told = {NAMES.get(name, name): value for name, value in statistics.items() if name not in OMITTED_STATISTICS}
    return [f"{x:,.0f} {name}" if x == int(x) else f"{name} {short(x)}" for name, x in told.items() if math.isfinite(x)]


def time_left(budget: Budget, step: int, seconds: float, begun: tuple[int, float]) -> float:
    """Remaining seconds of training: of a budget in seconds, or of the remaining steps at this session's speed."""
    if budget.steps is None:
        return max(budget.total - seconds, 0.0)
    return (budget.total - step) * (seconds - begun[1]) / max(step - begun[0], 1)


def learnt_from(data: Dataset) -> str:
    """Number of training and held-out inputs; size of photographs now and in the source."""
    held_out = len(data.splits.get("test", ()))
    aside = f", {held_out:,} held out"
    if isinstance(data, Words):
        return f"Learning from {data.source}"
    if not isinstance(data, Scene):
        return f"Learning from {len(data.splits['train']):,} of {data.kind}{aside}"
    count = len(data.splits["train"])
    size, full = pixel_sizes(data.cameras.size), None if data.full_sizes is None else pixel_sizes(data.full_sizes)
    reduced = f", reduced from {full}" if full and full != size else ""
    return f"Learning from {count:,} photograph{'' if count == 1 else 's'}{aside}, {size} pixels{reduced}"


def pixel_sizes(of: Int[Tensor, "photograph 2"]) -> str:
    """One size, or the smallest and the largest."""
    some = sorted({(int(w), int(h)) for w, h in of.tolist()}, key=lambda size: size[0] * size[1])
    told = [f"{width}x{height}" for width, height in some]
    return told[0] if len(told) == 1 else f"{told[0]} to {told[-1]}"


def learner(name: str, method: Any) -> str:
    """A method's name and size."""
    count, unit = extent(method)
    return f"{name}, {count:,} {unit}"


def extent(method: Any) -> tuple[int, str]:
    """Number of Gaussians, or of parameters, and their name."""
    if can(method, HasGaussians):
        return len(method.gaussians()), "Gaussians"
    return sum(x.numel() for x in method.parameters() if x.requires_grad), "numbers to learn"


def machine(device: torch.device) -> str:
    """Name of a device; on a CPU with its number of threads."""
    if device.type == "cuda":
        return f"on {torch.cuda.get_device_name(device)} ({device})"
    return f"on the CPU with {threads.description()}"


def how_long(budget: Budget, step: int, seconds: float) -> str:
    """Remaining budget. The time of a step is known only after some steps, and the beginning may have spent all."""
    if budget.steps is None:
        return f"for {lasting(left)}" if (left := budget.total - seconds) > 0 else "without a step of learning"
    done = f", {step:,} of them done" if step else ""
    return f"for {budget}{done}; how long they take is told once a few are done"
