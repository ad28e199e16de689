"""fit(): the loop that every method is trained by."""

from __future__ import annotations

import contextlib
import copy
import math
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from .display import TrainingDisplay
from .errors import LumigraphError
from .figures import save_picture
from .memory import peak_memory
from .method import Method
from .run import Run, State
from .scene import Batch, Photograph, Scene

FIRST_SAVE = 10.0  # seconds of training; a fault or a kill in the first minute should not cost all of it
PREVIEWS = (0.01, 0.03, 0.1, 0.3, 1.0)  # shares of the budget at which a view is kept
PREVIEW_SIZE = 256  # pixels along the longer side
SMALL = 1 << 16  # gradients up to this many numbers are looked at in every step, larger ones in every logged step


@dataclass(frozen=True)
class Outcome:
    """How training ended.

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
    """Somebody who looks on while a method learns, from other threads: the viewer. It may hold training up between
    steps, which does not count as training, and changes nothing of what is learnt."""

    @property
    def asked(self) -> bool:
        """Whether it wants to be given way before the next step. Asked before each step, so it must be quick."""

    def give_way(self, stopping: Callable[[], object]) -> None:
        """Render, in eval mode; return at once where stopping() is true."""

    def note(self, step: int, progress: float, row: dict[str, Any]) -> None:
        """So many steps are done. row: the line of metrics.jsonl, empty for most steps."""


def fit(
    method: Method,
    scene: Scene,
    run: Run | None = None,
    *,
    steps: int | None = None,
    seconds: float | None = None,
    seed: int = 0,
    pause_at: int | None = None,
    save_every: float = 60.0,
    log_every: int = 10,
    show: bool = True,
    watch: Watch | None = None,
) -> Outcome:
    """Train a method on a scene until its steps are done or its seconds are spent.

    run:        where the state is kept; training goes on from the state it holds. None keeps nothing
    steps, seconds: the whole budget, earlier sittings included; exactly one of them
    seed:       of all random choices
    pause_at:   stop at this step as if interrupted; the schedule still follows the whole budget
    save_every: seconds of training between states
    watch:      who looks on meanwhile
    Seconds count what training needs; compiling kernels ahead of it, saving, and giving way to who looks on are
    counted apart.
    Ctrl-C and SIGTERM end the step at hand, save and return; a second one breaks off.
    Raises LumigraphError when a loss or gradient is not finite, with the last good state saved.
    """
    budget = Budget(steps, seconds)
    state = run.restore_weights(method) if run else State()
    with Interrupt() as interrupt, TrainingDisplay(show) as display:
        display.say("Compiling kernels")
        compile_seconds = state.compile_seconds + rehearse(method, scene, state.step)
        optimizers, generator = method.optimizers(), torch.Generator().manual_seed(seed)
        if run:
            run.restore_training(optimizers, generator)
            run.forget_after(state.step)
        method.train()
        clock, step, watched = Clock(state.seconds), state.step, 0.0
        if step == 0:
            method.begin(scene)
        next_save = clock.seconds + min(FIRST_SAVE, save_every)
        previews = Previews(run, method, scene, budget.progress(step, clock.seconds))

        def save() -> State:
            if not finite(method.parameters()):
                raise LumigraphError(stop("a parameter is not finite", step, run, method, save))
            memory = max(state.peak_memory, peak_memory(method.device))
            now = State(step, clock.seconds, compile_seconds, memory)
            with clock.paused():
                previews.take(step, budget.progress(step, now.seconds))
                if run:
                    run.save(now, method, optimizers, generator)
            return now

        while (progress := budget.progress(step, clock.seconds)) < 1 and step != pause_at and not interrupt.signal:
            if watch and watch.asked:
                watched += give_way(watch, method, clock, interrupt)
                continue
            method.before_step(step, progress)
            batch = method.batch(scene, generator)
            terms = method.loss(batch, step)
            for optimizer in optimizers:
                optimizer.zero_grad(set_to_none=True)
            torch.stack(list(terms.values())).sum().backward()
            logged = (step + 1) % log_every == 0
            if fault := find_fault(method, terms, batch, step, thorough=logged):
                raise LumigraphError(stop(fault, step, run, method, save))
            for optimizer in optimizers:
                optimizer.step()
            method.after_step(step)
            step += 1
            row = display.update(step, clock.seconds, progress, batch, terms, method, needed=logged)
            if watch:
                watch.note(step, progress, row)
            if run and logged:
                run.log(row | {"learning_rate": [g["lr"] for o in optimizers for g in o.param_groups if "lr" in g]})
            if clock.seconds >= next_save and budget.progress(step, clock.seconds) < 1:  # the last save comes after
                save()
                next_save = clock.seconds + save_every
            elif previews.due(progress):
                with clock.paused():
                    previews.take(step, progress)

        final = save()
        display.done(step, final.seconds, budget.progress(step, final.seconds))
    method.eval()
    return Outcome(final, budget.progress(step, final.seconds) >= 1, interrupt.signal, clock.pauses - watched)


@dataclass(frozen=True)
class Budget:
    """When training ends: after a number of steps, or of seconds."""

    steps: int | None
    seconds: float | None

    def __post_init__(self) -> None:
        if (self.steps is None) == (self.seconds is None):
            raise LumigraphError("Training needs either steps or seconds, and not both; give one of them")
        if not 0 < (self.steps or self.seconds or 0) < math.inf:
            raise LumigraphError(f"Training cannot last {self.steps or self.seconds or 0}; give a number above 0")

    def progress(self, step: int, seconds: float) -> float:
        """The share that is spent, in [0, 1]."""
        return min(step / self.steps if self.steps else seconds / (self.seconds or 1), 1.0)


class Clock:
    """Seconds of training. It runs from the moment it is made, except during pauses."""

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


class Interrupt:
    """Inside this block the first Ctrl-C or SIGTERM only leaves its number; the second acts as usual."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self._previous: dict[int, object] = {}

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():  # only there may handlers be set
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *fault: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _note(self, number: int, frame: object) -> None:
        self.signal = number
        self.__exit__()


class Previews:
    """One view as it comes to be: the first held-out one, small."""

    def __init__(self, run: Run | None, method: Method, scene: Scene, progress: float):
        held_out = scene.splits.get("test")
        index = held_out if held_out is not None and len(held_out) else scene.splits["train"]
        camera = scene.cameras[int(index[0])]
        self.camera = camera.resized(min(1.0, PREVIEW_SIZE / int(camera.size.max())))
        self.run, self.method = run, method
        self.next = [share for share in PREVIEWS if share > progress] if run else []

    def due(self, progress: float) -> bool:
        return bool(self.next) and progress >= self.next[0]

    def take(self, step: int, progress: float) -> None:
        """Render and keep the view if it is due."""
        if not self.run or not self.due(progress):
            return
        self.next = [share for share in self.next if share > progress]
        self.method.eval()
        save_picture(self.run.folder / "previews" / f"{step:06d}.png", self.method.render(self.camera).rgb)
        self.method.train()


def give_way(watch: Watch, method: Method, clock: Clock, interrupt: Interrupt) -> float:
    """Let somebody look, who has asked. Returns the seconds it took."""
    before = clock.pauses
    with clock.paused():
        method.eval()
        watch.give_way(lambda: interrupt.signal)
        method.train()
    return clock.pauses - before


def rehearse(method: Method, scene: Scene, step: int) -> float:
    """One step on a copy, so that all kernels are compiled before the clock starts. Returns the seconds it took."""
    begin = time.perf_counter()
    double = copy.deepcopy(method).train()
    optimizers = double.optimizers()
    double.before_step(step, 0.0)
    terms = double.loss(double.batch(scene, torch.Generator().manual_seed(0)), step)
    for optimizer in optimizers:
        optimizer.zero_grad(set_to_none=True)
    torch.stack(list(terms.values())).sum().backward()
    for optimizer in optimizers:
        optimizer.step()
    double.after_step(step)
    return time.perf_counter() - begin


def find_fault(
    method: Method, terms: dict[str, Tensor], batch: Batch | Photograph, step: int, thorough: bool
) -> str | None:
    """The loss term that is not finite, or whose gradient is not; None if all is well.

    thorough: look at all gradients. Small ones, which everything flows through, are always looked at.
    """
    for name, value in terms.items():
        if not math.isfinite(value.item()):
            return f"the loss term {name!r} is {value.item()}"
    named = [(n, p) for n, p in method.named_parameters() if p.grad is not None]
    if finite(p.grad for _, p in named if p.grad is not None and (thorough or p.numel() <= SMALL)):
        return None
    for term, value in method.loss(batch, step).items():  # once more, one term at a time
        gradients = torch.autograd.grad(value, [p for _, p in named], retain_graph=True, allow_unused=True)
        for (parameter, _), gradient in zip(named, gradients, strict=True):
            if gradient is not None and not finite([gradient]):
                return f"the gradient of the loss term {term!r} in {parameter!r} is not finite"
    return "the gradient of the summed loss is not finite"


def finite(tensors: Iterable[Tensor]) -> bool:
    """Whether every number is finite. Their sum tells: it reads each once, and passes NaN and infinity on."""
    sums = [x.detach().sum(dtype=torch.float32) for x in tensors if x.is_floating_point()]
    return not sums or math.isfinite(torch.stack(sums).sum().item())


def stop(fault: str, step: int, run: Run | None, method: Method, save) -> str:
    """Keep the last good state, and say in one sentence what happened and where that state is."""
    if run is None:
        return f"Training stopped at step {step} because {fault}; try a lower learning rate"
    if finite(method.parameters()):
        save()
    kept = f"the state after step {run.state.step} is kept" if run.has_state else "no state had been saved yet"
    return f"Training stopped at step {step} because {fault}; {kept} in {run.folder}; try a lower learning rate"
