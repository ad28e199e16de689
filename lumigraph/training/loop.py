"""fit(): the training loop of all methods."""

from __future__ import annotations

import contextlib
import copy
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor
from torch.autograd.profiler import record_function as span

from .. import methods
from ..budget import Budget
from ..datasets.dataset import Dataset, check_kind
from ..errors import LumigraphError
from ..figures import save_picture
from ..method import Lesson, Method
from ..run import Run, State, check_memory
from ..system.memory import peak_memory
from ..system.progress import counting, report
from ..system.signals import Interrupt
from ..system.work import at_work
from .demand import about_memory
from .display import TrainingDisplay
from .loggers import Logger, Loggers
from .verdict import shares_seen

FIRST_SAVE_SECONDS = 10.0  # seconds of training; a fault or a kill in the first minute should not cost all of it
PREVIEW_SHARES = (0.01, 0.03, 0.1, 0.3, 1.0)  # shares of the budget at which a view is kept
PREVIEW_SIZE = 256  # pixels along the longer side
MIN_ERROR = 1e-10  # mean squared error below which the PSNR stays 100 dB
MAX_SMALL_GRADIENT = 1 << 16  # numbers of a gradient that is checked in every step; larger ones in logged steps only


@dataclass(frozen=True)
class Outcome:
    """Result of training.

    finished: whether the budget is spent
    signal:   number of the signal that stopped it, if one did
    saving_seconds: spent on checkpoints and previews, beside the training's seconds
    """

    state: State
    finished: bool
    signal: int | None = None
    saving_seconds: float = 0.0


@runtime_checkable
class Watch(Protocol):
    """Observer of training on other threads: the viewer. It may pause training between steps, which does not count as
    training time, and changes nothing of the result."""

    @property
    def asked(self) -> bool:
        """True if training is to pause before the next step. Read before each step, so it must be fast."""

    def give_way(self, stopping: Callable[[], object]) -> None:
        """Render, in eval mode; return at once where stopping() is true."""

    def note(self, step: int, progress: float, row: dict[str, Any]) -> bool | None:
        """Report a completed step. row: line of metrics.jsonl, mostly empty. Returns true to stop, as by Ctrl-C."""


@at_work()
def fit(
    method: Method,
    data: Dataset,
    run: Run | None = None,
    *,
    steps: int | None = None,
    seconds: float | None = None,
    budget: Budget | None = None,
    seed: int = 0,
    pause_at: int | None = None,
    save_every: float = 60.0,
    log_every: int = 10,
    show: bool = True,
    watch: Watch | None = None,
    rehearsal: bool = True,
    loggers: Iterable[str | Logger] = (),
) -> Outcome:
    """Train a method on a dataset until its steps are done or its seconds are spent.

    run:        folder of the state; training continues from its state. None saves nothing
    steps, seconds: the whole budget, earlier sessions included; exactly one of them, or
    budget:     a Budget, such as that of an extended run
    seed:       of all random choices
    pause_at:   stop at this step as if interrupted; the schedule still follows the whole budget
    save_every: seconds of training between checkpoints
    watch:      observer, such as the viewer
    loggers:    receivers of each line of metrics.jsonl and of previews, by name or as objects, see `loggers`
    rehearsal:  compile all kernels by a step on a copy before the clock starts; tests without timing skip it
    Seconds are those of training alone; compiling kernels before it, saving, and pauses for the observer are counted
    apart. Ctrl-C and SIGTERM finish the current step, save and return; a second one aborts. Raises LumigraphError for a
    dataset of another kind than the method learns from, for a run that another process trains, and for a loss or
    gradient that is not finite, after saving the last good state.
    """
    budget = budget or Budget(steps, seconds)
    check_kind(methods.name_of(method), method.learns_from, type(data), data.source)
    check_memory(type(method), method.frame, method.config, method.device, learning=True)
    logged_to = Loggers(loggers, run)
    locked = run.lock() if run else contextlib.nullcontext()
    with locked, Interrupt() as interrupt, TrainingDisplay(show) as display, logged_to:
        fresh, state = not (run and run.has_state), run.restore_weights(method) if run else State()
        if fresh:
            method.check_data(data)
        display.begin(data, about_memory(method, data))
        compile_seconds = state.compile_seconds
        if rehearsal:
            with display.aside(), counting("Compiling kernels"):
                compile_seconds += rehearse(method, data, state.step)
        optimizers, generator = method.optimizers(), torch.Generator().manual_seed(seed)
        if run:
            run.restore_training(optimizers, generator)
            run.forget_after(state.step)
        method.train()
        share_seen, passes, losses = shares_seen(data), state.passes, list[float]()
        clock, step, watched, ended = Clock(state.seconds), state.step, 0.0, False
        if fresh:
            with display.aside():
                method.begin(data, budget.seconds or math.inf)
        display.ready(methods.name_of(method), method, budget, step, clock.seconds)
        next_save = clock.seconds + min(FIRST_SAVE_SECONDS, save_every)

        def spent(seconds: float | None = None) -> float:
            now = clock.seconds if seconds is None else seconds
            return 1.0 if method.complete else budget.progress(step, now)

        previews = Previews(run, method, data, spent(), logged_to)

        def save() -> State:
            if not finite(method.parameters()):
                refuse("a parameter is not finite")
            memory = max(state.peak_memory, peak_memory(method.device))
            now = State(step, clock.seconds, compile_seconds, memory, passes)
            with clock.paused():
                previews.take(step, spent(now.seconds))
                if run:
                    run.save(now, method, optimizers, generator)
            return now

        def refuse(fault: str) -> None:
            raise LumigraphError(stop(fault, step, run, method, save))

        while (progress := spent()) < 1 and step != pause_at and not (ended or interrupt.signal):
            if watch and watch.asked:
                watched += give_way(watch, method, clock, interrupt)
                continue
            logged = (step + 1) % log_every == 0
            batch, terms = advance(method, data, optimizers, generator, step, progress, logged, refuse)
            step += 1
            passes += share_seen(batch)
            losses.append(sum(value.item() for value in terms.values()))
            row = record(step, clock.seconds, terms, method, losses, passes) if logged or display.due else {}
            display.update(step, clock.seconds, budget, batch, row)
            if watch:
                ended = bool(watch.note(step, progress, row))
            report("Training", step, budget.steps)
            if logged:
                losses.clear()
            if run and logged:
                logged_to.row(step, row)
                run.log(row | {"learning_rate": [g["lr"] for o in optimizers for g in o.param_groups if "lr" in g]})
            if clock.seconds >= next_save and spent() < 1:  # the last save comes after
                save()
                next_save = clock.seconds + save_every
            elif previews.due(progress):
                with clock.paused():
                    previews.take(step, progress)

        final = save()
        finished = spent(final.seconds) >= 1
        display.done(step, final.seconds, spent(final.seconds))
    method.eval()
    return Outcome(final, finished, interrupt.signal, clock.pauses - watched)


def advance(
    method: Method,
    data: Dataset,
    optimizers: Sequence[torch.optim.Optimizer],
    generator: torch.Generator,
    step: int,
    progress: float,
    thorough: bool = False,
    refuse: Callable[[str], None] = lambda fault: None,
) -> tuple[Lesson, dict[str, Tensor]]:
    """One training step: its batch, and the terms of its loss. Spans name its parts for `bench step`.

    progress: share of the budget that is spent; thorough, refuse: see `Descent`
    """
    method.progress = progress
    set_learning_rate(optimizers, method.learning_rates(step, progress))
    with span("before step"):
        method.before_step(step, progress)
    with span("data"):
        batch = method.batch(data, generator)
    with span("forward"):
        terms = method.step(batch, step, Descent(method, optimizers, batch, step, thorough, refuse))
    with span("after step"):
        method.after_step(step)
    return batch, terms


class Descent:
    """Descent of one step, passed to `Method.step` as `descend`: gradients of the summed terms, a check that they are
    finite, and the optimizers' step.

    thorough: check all gradients, see `find_fault`
    refuse:   raises, with a description of what is not finite
    """

    def __init__(
        self,
        method: Method,
        optimizers: Sequence[torch.optim.Optimizer],
        batch: Lesson,
        step: int,
        thorough: bool,
        refuse: Callable[[str], None],
    ):
        self.method, self.optimizers, self.batch, self.step = method, optimizers, batch, step
        self.thorough, self.refuse = thorough, refuse

    def __call__(self, terms: dict[str, Tensor], optimizers: Sequence[torch.optim.Optimizer] | None = None) -> None:
        """Take one step with some of the optimizers, or with all."""
        chosen = self.optimizers if optimizers is None else optimizers
        for optimizer in chosen:
            optimizer.zero_grad(set_to_none=True)
        with span("backward"):
            torch.stack(list(terms.values())).sum().backward()
        with span("check"):
            if fault := find_fault(self.method, terms, self.batch, self.step, self.thorough):
                self.refuse(fault)
        with span("optimizer"):
            for optimizer in chosen:
                optimizer.step()


def record(
    step: int, seconds: float, terms: dict[str, Tensor], method: Method, losses: Sequence[float], passes: float
) -> dict[str, Any]:
    """A line of metrics.jsonl: the loss and its terms, the method's figures, PSNR of the batch where the method reports
    a squared error of colours, the mean loss since the previous line, and the passes over the data so far."""
    own = {name: value.item() for name, value in terms.items()}
    statistics = {name: float(value) for name, value in method.statistics().items()}
    row: dict[str, Any] = {"step": step, "seconds": round(seconds, 4)}
    if own:
        row |= {"loss": sum(own.values()), "mean_loss": sum(losses) / len(losses), "passes": round(passes, 6)}
    if "mse" in statistics:
        row["psnr"] = -10 * math.log10(max(statistics["mse"], MIN_ERROR))
    return row | {"terms": own, "statistics": statistics}


def set_learning_rate(optimizers: Iterable[torch.optim.Optimizer], rates: dict[str, float]) -> None:
    """Set the learning rates of groups of parameters by their names; see `Method.learning_rates`."""
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            own = rates.get(group.get("name", ""))
            if own is not None:
                group["lr"] = own * group.get("scale", 1.0)


class Clock:
    """Stopwatch of training seconds. It runs from construction on, except during pauses."""

    def __init__(self, seconds: float = 0.0):
        self._begin, self.pauses = time.perf_counter() - seconds, 0.0

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._begin

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        pause = time.perf_counter() - begin
        self._begin, self.pauses = self._begin + pause, self.pauses + pause


class Previews:
    """Small previews of one view during training, by the dataset's preview camera. None without such a camera."""

    def __init__(self, run: Run | None, method: Method, data: Dataset, progress: float, loggers: Loggers):
        camera = data.preview() if run else None
        self.camera = camera and camera.resized(min(1.0, PREVIEW_SIZE / int(camera.size.max())))
        self.run, self.method, self.loggers = run, method, loggers
        self.next = [share for share in PREVIEW_SHARES if share > progress] if camera else []

    def due(self, progress: float) -> bool:
        return bool(self.next) and progress >= self.next[0]

    def take(self, step: int, progress: float) -> None:
        """Render and save a preview if it is due."""
        if not self.run or self.camera is None or not self.due(progress):
            return
        self.next = [share for share in self.next if share > progress]
        self.method.eval()
        rgb = self.method.render(self.camera).rgb
        save_picture(self.run.folder / "previews" / f"{step:06d}.png", rgb, ours=True)
        self.loggers.preview(step, rgb.cpu())
        self.method.train()


def give_way(watch: Watch, method: Method, clock: Clock, interrupt: Interrupt) -> float:
    """Pause training while the viewer renders. Returns the seconds of the pause."""
    before = clock.pauses
    with clock.paused():
        method.eval()
        watch.give_way(lambda: interrupt.signal)
        method.train()
    return clock.pauses - before


def rehearse(method: Method, data: Dataset, step: int) -> float:
    """Compile all kernels by one step on a copy, before the clock starts. Returns the seconds it took."""
    begin = time.perf_counter()
    double = copy.deepcopy(method).train()
    optimizers = double.optimizers()
    if step == 0:
        double.compile_begin()
    advance(double, data, optimizers, torch.Generator().manual_seed(0), step, 0.0)
    return time.perf_counter() - begin


def find_fault(method: Method, terms: dict[str, Tensor], batch: Lesson, step: int, thorough: bool) -> str | None:
    """Name the loss term that is not finite, or whose gradient is not; None if all are finite.

    thorough: check all gradients. Small ones, through which all others flow, are always checked.
    """
    for name, value in terms.items():
        if not math.isfinite(value.item()):
            return f"the loss term {name!r} is {value.item()}"
    named = [(n, p) for n, p in method.named_parameters() if p.grad is not None]
    if finite(p.grad for _, p in named if p.grad is not None and (thorough or p.numel() <= MAX_SMALL_GRADIENT)):
        return None
    again = method.loss(batch, step) if type(method).step is Method.step else {}
    for term, value in again.items():  # one at a time
        gradients = torch.autograd.grad(value, [p for _, p in named], retain_graph=True, allow_unused=True)
        for (parameter, _), gradient in zip(named, gradients, strict=True):
            if gradient is not None and not finite([gradient]):
                return f"the gradient of the loss term {term!r} in {parameter!r} is not finite"
    return "the gradient of the summed loss is not finite"


def finite(tensors: Iterable[Tensor]) -> bool:
    """True if all numbers are finite. The sum reads each number once and propagates NaN and infinity."""
    sums = [x.detach().sum(dtype=torch.float32) for x in tensors if x.is_floating_point()]
    return not sums or math.isfinite(torch.stack(sums).sum().item())


def stop(fault: str, step: int, run: Run | None, method: Method, save) -> str:
    """Save the last good state. Returns one sentence on the fault and the state's location."""
    if run is None:
        return f"Training stopped at step {step} because {fault}; try a lower learning rate"
    if finite(method.parameters()):
        save()
    kept = f"the state after step {run.state.step} is kept" if run.has_state else "no state had been saved yet"
    return f"Training stopped at step {step} because {fault}; {kept} in {run.folder}; try a lower learning rate"
