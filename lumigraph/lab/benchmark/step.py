"""Profile of one training step: time of each kernel and PyTorch operation, and memory traffic against bandwidth.

Time is that of PyTorch's profiler, with a span for each kernel (`kernels.watching`) and for each part of a step
(`training.advance`). Bytes are counted in a separate step: each tensor that an operation reads or writes, once. So a
kernel that passes over its data twice moves more, and one with data in cache moves less. CPU milliseconds of the
training thread are given for kernels and optimizers: beside other programs only they are comparable.
"""

from __future__ import annotations

import itertools
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache, partial
from typing import Any

import torch
from rich.table import Table
from torch import Tensor
from torch.autograd.profiler import record_function as span
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode

from ...datasets.dataset import Dataset
from ...figures.flame import Span, flame_graph
from ...kernels import operations, watching
from ...method import Method
from ...run import Run, State
from ...system.threads import TASKS_FOLDER, Contention
from ...system.work import at_work
from ...training.loop import advance

KINDS = "kernel", "operation", "optimizer", "data", "check", "autograd", "Python"
WHOLE = {"data": "photographs and rays", "check": "finite loss and gradients"}  # parts of a step that are one row
BEGIN_SECONDS = 60.0  # budget that a fresh method is initialised for
COPY_BYTES = 1 << 28  # of the tensor whose copy measures the memory's rate
PARTS = "step", "before step", "forward", "backward", "optimizer", "after step"  # spans that are taken apart
DESCENT = "backward", "check", "optimizer"  # of them, and of WHOLE, those within a method's `step`
STEP, BYTES = "step", "bytes "  # names of spans: a whole step; a mark with a number of bytes
NODE, ATEN, UPDATE = "autograd::engine::evaluate_function: ", "aten::", "Optimizer.step#"


@dataclass(frozen=True)
class StepRow:
    """A kernel, an operation or another part of a step, per step.

    kind:  one of KINDS
    bytes: of all tensors read and written, each counted once; 0 if not counted
    processor_ms: CPU time of this thread, of kernels and optimizers
    """

    name: str
    kind: str
    calls: float = 0.0
    ms: float = 0.0
    bytes: float = 0.0
    processor_ms: float = 0.0

    def plus(self, calls: float = 0.0, ms: float = 0.0, bytes: float = 0.0) -> StepRow:
        return replace(self, calls=self.calls + calls, ms=self.ms + ms, bytes=self.bytes + bytes)


@dataclass(frozen=True)
class Anatomy:
    """Profile of a step.

    rows:        largest first; their milliseconds sum up to `profiled_ms`
    tree:        the same as nested spans
    ms:          median of a step without the profiler
    processor_ms: CPU time of the training thread
    profiled_ms: mean of the faster half of the profiled steps
    waiting:     contention: share of runnable time in which other programs had the processor
    memory_rate: memory bandwidth in bytes per second, of a large copy
    """

    rows: list[StepRow]
    tree: Span
    ms: float
    processor_ms: float
    profiled_ms: float
    waiting: float
    memory_rate: float

    def to_json(self) -> dict[str, Any]:
        rows = [
            {"name": r.name, "kind": r.kind, "calls": r.calls, "ms": r.ms, "share": r.ms / self.profiled_ms}
            | ({"processor_ms": r.processor_ms} if r.processor_ms else {})
            | ({"bytes": r.bytes, "memory_share": self.memory_share(r)} if r.bytes else {})
            for r in self.rows
        ]
        names = "ms", "processor_ms", "profiled_ms", "waiting", "memory_rate"
        return {name: getattr(self, name) for name in names} | {"rows": rows}

    def memory_share(self, row: StepRow) -> float:
        """Rate of a row's bytes as a share of the memory bandwidth. Above 1 with data in a cache."""
        return row.bytes / (row.ms / 1e3) / self.memory_rate if row.ms else 0.0

    def graph(self) -> str:
        """Flame graph as SVG text."""
        return flame_graph(self.tree, "ms", KINDS)

    def table(self, title: str, min_share: float = 0.005) -> Table:
        """The rows above a share, the others summed."""
        table = Table("part", "kind", "calls", "ms", "share\n%", "running\nms", "MB", "of memory\n%", title=title)
        table.columns[0].no_wrap = True
        for column in table.columns[2:]:
            column.justify = "right"
        small = [r for r in self.rows if r.ms < min_share * self.profiled_ms]
        for r in self.rows[: len(self.rows) - len(small)]:
            moved = f"{r.bytes / 1e6:.2f}", f"{100 * self.memory_share(r):.0f}"
            numbers = f"{r.calls:.3g}", f"{r.ms:.2f}", f"{100 * r.ms / self.profiled_ms:.1f}"
            running = f"{r.processor_ms:.2f}" if r.processor_ms else ""
            table.add_row(r.name, r.kind, *numbers, running, *(moved if r.bytes and r.ms else ()))
        rest = sum(r.ms for r in small)
        table.add_row(f"{len(small)} smaller ones", "", "", f"{rest:.2f}", f"{100 * rest / self.profiled_ms:.1f}")
        table.caption = (
            f"a step takes {self.ms:.1f} ms and runs for {self.processor_ms:.1f} ms of them; with the profiler "
            f"{self.profiled_ms:.1f} ms; memory moves {self.memory_rate / 1e9:.1f} GB/s; other programs had the "
            f"processor for {100 * self.waiting:.0f} % of the time"
        )
        return table


@at_work()
def bench_step(
    method: Method, data: Dataset, run: Run | None, warmup: int, count: int, progress: float, seed: int = 0
) -> Anatomy:
    """Profile steps of a fresh method, or of a run's, whose folder is not changed.

    warmup:   steps before, in which the share of the budget rises to `progress` for a fresh method
    count:    number of profiled steps
    progress: share of the budget for schedules
    """
    state = run.restore_weights(method) if run else State()
    optimizers, generator = method.optimizers(), torch.Generator().manual_seed(seed)
    if run:
        run.restore_training(optimizers, generator)
    method.train()
    number = itertools.count(state.step)

    def step(share: float) -> None:
        advance(method, data, optimizers, generator, next(number), share)

    if not run:
        method.begin(data, BEGIN_SECONDS)
    for i in range(warmup):
        step(progress if run else progress * i / warmup)
    return take_apart(partial(step, progress), optimizers, count)


def take_apart(step: Callable[[], Any], optimizers: Sequence[torch.optim.Optimizer], count: int) -> Anatomy:
    """Measure training steps: `count` alone, `count` with the profiler, and one more to count bytes.

    step: runs the next step, by `training.advance`. On a GPU launches must be synchronous: CUDA_LAUNCH_BLOCKING=1.
    """
    alone, running = (statistics.median(column) for column in zip(*(seconds(step) for _ in range(count)), strict=True))
    clock, contention = RunningClock(), Contention() if TASKS_FOLDER.exists() else None
    with watching(clock.kernel), clock.of(optimizers), profile(activities=[ProfilerActivity.CPU]) as profiler:
        for _ in range(count):
            with span(STEP):
                step()
    waiting = contention() if contention else 0.0
    steps = sorted((e for e in profiler.events() if e.name == STEP), key=lambda e: e.cpu_time_total)
    quick = steps[: (count + 1) // 2]
    rows, tree = dict[str, StepRow](), Span(STEP, 0.0, KINDS.index("Python"))
    for event in quick:
        add(event, [tree], None, rows, 1 / len(quick))
    for name, moved in traffic(step, optimizers):
        if name in rows:
            rows[name] = rows[name].plus(bytes=moved)
    found = [replace(row, processor_ms=1e3 * clock.spent[row.name] / count) for row in rows.values()]
    found.sort(key=lambda row: -row.ms)
    return Anatomy(found, tree, 1e3 * alone, 1e3 * running, tree.value, waiting, memory_rate())


def seconds(call: Callable[[], Any]) -> tuple[float, float]:
    """Wall-clock and CPU seconds of a call."""
    begin, ran = time.perf_counter(), time.thread_time()
    call()
    return time.perf_counter() - begin, time.thread_time() - ran


class RunningClock:
    """CPU seconds of this thread in each kernel and optimizer, by the name of its row."""

    def __init__(self) -> None:
        self.spent: defaultdict[str, float] = defaultdict(float)

    def kernel(self, name: str, call: Callable[[], Any], inputs: tuple) -> Any:
        with span(name):
            begin = time.thread_time()
            found = call()
            self.spent[name] += time.thread_time() - begin
            return found

    @contextmanager
    def of(self, optimizers: Sequence[torch.optim.Optimizer]) -> Iterator[None]:
        """Block in which optimizers' steps are counted too."""

        def count(sign: int, optimizer: torch.optim.Optimizer, *_: Any) -> None:
            self.spent[update_of(optimizer)] += sign * time.thread_time()

        hooks = [o.register_step_pre_hook(partial(count, -1)) for o in optimizers]
        hooks += [o.register_step_post_hook(partial(count, 1)) for o in optimizers]
        yield
        for hook in hooks:
            hook.remove()


def update_of(optimizer: torch.optim.Optimizer) -> str:
    """Name of the row of an optimizer's steps."""
    return f"{type(optimizer).__name__}.step"


def add(event: Any, around: list[Span], row: StepRow | None, rows: dict[str, StepRow], weight: float) -> None:
    """Add a profiled event and its children to the tree and the rows.

    around: enclosing spans, the whole step first
    row:    of an enclosing event that is a single row
    """
    name, ms = plain(event.name), weight * event.cpu_time_total / 1e3
    own = row or whole(event.name)
    mine = own or remainder(name)
    if name in DESCENT:  # lies in the method's `step`, beside whose forward part it belongs
        around[-1].value -= ms
        around = around[:1]
    if event.name == STEP:
        around[0].value += ms
    elif not around[-1].name.startswith(name):
        around = [*around, inner(around[-1], name, KINDS.index(mine.kind))]
        around[-1].value += ms
    calls = 0.0 if row or not own else weight
    rows[mine.name] = rows.get(mine.name, mine).plus(calls, weight * event.self_cpu_time_total / 1e3)
    for one in event.cpu_children:
        add(one, around, own, rows, weight)


def inner(around: Span, name: str, kind: int) -> Span:
    """The span of a name inside another."""
    for one in around.inside:
        if one.name == name:
            return one
    around.inside.append(Span(name, 0.0, kind))
    return around.inside[-1]


def plain(event: str) -> str:
    """Name of an event without the profiler's prefixes."""
    return event.removeprefix(NODE).removeprefix(ATEN).removeprefix(UPDATE)


def whole(event: str) -> StepRow | None:
    """Row of an event including its children; None for spans that are split."""
    name = plain(event)
    if name in WHOLE:
        return StepRow(WHOLE[name], name)
    if event.startswith(UPDATE):
        return StepRow(name, "optimizer")
    if name in kernel_spans():
        return StepRow(name, "kernel")
    return StepRow(name, "operation") if event.startswith(ATEN) else None


@cache
def kernel_spans() -> frozenset[str]:
    """Names of the spans of all kernels."""
    return frozenset(f"{name} {way}" for name in operations() for way in ("forward", "backward"))


def remainder(name: str) -> StepRow:
    """Row of a span's self time, without rows inside."""
    return StepRow(f"{name}, between", "Python") if name in PARTS else StepRow("graph of gradients", "autograd")


def traffic(step: Callable[[], Any], optimizers: Sequence[torch.optim.Optimizer]) -> Iterator[tuple[str, int]]:
    """Names of rows, and their bytes in one step."""
    mode = Traffic()
    with watching(mode.kernel), profile(activities=[ProfilerActivity.CPU]) as profiler, mode:
        with span(STEP):
            step()
    for event in profiler.events():
        if event.name.startswith(BYTES) and (row := row_around(event)):
            yield row.name, int(event.name.removeprefix(BYTES))
    for optimizer in optimizers:
        yield update_of(optimizer), sum(moved_by(optimizer))


def row_around(event: Any) -> StepRow | None:
    """Row of an event: that of the outermost enclosing event with one."""
    found = None
    while event := event.cpu_parent:
        found = whole(event.name) or found
    return found if found and found.kind in ("kernel", "operation") else None


class Traffic(TorchDispatchMode):
    """Markers of each operation's bytes among the profiler's events; of a kernel only inputs and outputs."""

    def __init__(self) -> None:
        super().__init__()
        self.inside = 0

    def kernel(self, name: str, call: Callable[[], Any], inputs: tuple) -> Any:
        with span(name):
            self.inside += 1
            try:
                found = call()
            finally:
                self.inside -= 1
            mark(bytes_of(inputs) + bytes_of(found))
            return found

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        found = func(*args, **(kwargs or {}))
        if not self.inside and moves(func):
            mark(bytes_of(args) + bytes_of(kwargs) + bytes_of(found))
        return found


def mark(count: int) -> None:
    with span(f"{BYTES}{count}"):
        pass


def moves(function: Any) -> bool:
    """False for operations without memory traffic: views, and empty tensors."""
    returned = [r.alias_info for r in function._schema.returns]
    view = any(alias is not None and not alias.is_write for alias in returned)
    return not view and not function._schema.name.startswith("aten::empty")


def bytes_of(value: Any) -> int:
    """Bytes of the tensors in a value, without repetition where a tensor is expanded."""
    if isinstance(value, Tensor):
        return min(value.numel() * value.element_size(), value.untyped_storage().nbytes())
    if isinstance(value, dict):
        return sum(map(bytes_of, value.values()))
    if isinstance(value, list | tuple):
        return sum(map(bytes_of, value))
    if is_dataclass(value):
        return sum(bytes_of(getattr(value, x.name)) for x in fields(value))
    return sum(map(bytes_of, getattr(value, "saved_tensors", ())))


def moved_by(optimizer: torch.optim.Optimizer) -> Iterator[int]:
    """Bytes of each parameter's update: the gradient read; the parameter and its moments read and written."""
    for group in optimizer.param_groups:
        for p in group["params"]:
            if p.grad is not None:
                yield bytes_of(p.grad) + 2 * bytes_of(p.data) + 2 * bytes_of(optimizer.state.get(p, {}))


def memory_rate() -> float:
    """Memory bandwidth in bytes per second: reads and writes of a copy, the best of five."""
    source = torch.ones(COPY_BYTES // 4)
    target = torch.empty_like(source)
    return 2 * COPY_BYTES / min(seconds(lambda: target.copy_(source))[0] for _ in range(5))
