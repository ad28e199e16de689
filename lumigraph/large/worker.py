"""Train one block of a large scene: a function over the folder of the block, the same on every machine.

    RUN/blocks/3/
    ├── task.json     what it is made of, all of it
    ├── config.json, cameras.json, checkpoints/, metrics.jsonl ...   an ordinary run
    └── done.json     last, with a hash of the task

A finished block is skipped, a block with a state continues from it, any other begins. So it may be called again after
the loss of a process or a machine.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numba
import numpy as np
import torch

from .. import files, methods
from ..budget import Budget
from ..datasets.scene import Scene
from ..errors import LumigraphError
from ..files.locks import held
from ..files.ranges import typed
from ..method import Method
from ..opening import open_dataset
from ..readers import Before
from ..run import Run, build
from ..run.records import warn_of_changes
from ..training.loop import fit
from .plan import DONE_FILE, Done, Task

LOCK_TIMEOUT = 60.0  # seconds to wait for a stopped process that still holds the folder
SAVE_SECONDS = 30.0  # of training, the most that a lost worker costs


@dataclass(frozen=True)
class Ended:
    """End of a call: with what the block took, or by a signal before it was done."""

    done: Done | None
    signal: int | None = None


@dataclass(frozen=True)
class Conducted:
    """Outcome of all blocks: what blocks took by name, a sentence for each that failed, and the signal that
    stopped it."""

    done: dict[str, Done]
    failed: dict[str, str]
    signal: int | None = None


def train_block(folder: Path, save_every: float = SAVE_SECONDS) -> Ended:
    """Learn what a block's task.json says, as far as that is not done.

    Of a budget in steps the weights are the same to the bit, however often this was interrupted, on a CPU. Ctrl-C and
    SIGTERM save. Raises LumigraphError for a task that cannot be done, and where the folder may not be written.
    """
    task = Task.read(folder)
    if (done := finished(folder, task)) is not None:
        return Ended(done)
    with patiently_held(folder), limited(task.threads):
        if (done := finished(folder, task)) is not None:  # by the process that held it
            return Ended(done)
        begin = time.perf_counter()
        data = opened(task)
        opening = time.perf_counter() - begin
        run, method = begun(folder, task, data)
        budget = Budget.from_json(run.settings.budget)
        outcome = fit(method, data, run, budget=budget, seed=task.seed, save_every=save_every, show=False)
        if not outcome.finished:
            return Ended(None, outcome.signal)
        state = run.state
        took = state.step, state.seconds, state.compile_seconds, opening, state.peak_memory
        done = Done(task.key, *took, len(data), run.model_bytes)
        files.write_json(folder / DONE_FILE, asdict(done), ours=True)
    return Ended(done)


def finished(folder: Path, task: Task) -> Done | None:
    """Cost of a block that is done, None of any other. Raises LumigraphError for one that was another task's."""
    if not (folder / DONE_FILE).exists():
        return None
    done: Done = files.read_json(folder / DONE_FILE, Done)
    if done.key != task.key:
        raise LumigraphError(
            f"{folder} was trained for other settings than its task.json says; choose another --output"
        )
    return done


def opened(task: Task) -> Scene:
    """The photographs of a block, in a frame of its own that stands as all the others do."""
    options = {name: value for name, value in task.scene.options.items() if value is not None}
    before = Before(options["part"]["photographs"], np.array(task.upright))
    data = open_dataset(task.scene.source, Scene, **options, memory=task.memory, before=before)
    assert isinstance(data, Scene)
    return data


def begun(folder: Path, task: Task, data: Scene) -> tuple[Run, Method]:
    """The run in a block's folder and its method, as far as it had come. Raises LumigraphError for another's run."""
    kind, device = methods.find(task.method), torch.device(task.device)
    if (folder / "config.json").exists():
        run = Run(folder)
        mine = task.config, task.seed, task.scene.options["part"]
        if (run.settings.config, run.settings.seed, run.settings.scene.options.get("part")) != mine:
            raise LumigraphError(f"{folder} holds a run of other settings; choose another --output")
        warn_of_changes(run.digests(), data, folder)
        return run, run.new_method(device)
    config = typed(kind.Config, task.config, folder / "task.json", closed=True)
    method = build(kind, data.frame, config, device, task.seed, learning=True)
    said = dict(task.budget)
    if "quality" in said:
        said["steps"] = method.steps_for(said["quality"], data)
    budget = Budget.from_json(said, folder / "task.json")
    options = task.scene.options
    return Run.create(folder, method, data, seed=task.seed, options=options, budget=budget.to_json()), method


@contextmanager
def patiently_held(folder: Path) -> Iterator[None]:
    """Hold a block's folder; wait for a while for a process that is about to end. Raises LumigraphError as `held`."""
    until = time.monotonic() + LOCK_TIMEOUT
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(held(folder, "trained"))
                break
            except LumigraphError:
                if time.monotonic() > until:
                    raise
                time.sleep(0.5)
        yield


@contextmanager
def limited(threads: int | None) -> Iterator[None]:
    """A block in which PyTorch and Numba use so many threads; None for as many as they did."""
    if threads is None:
        yield
        return
    before = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(threads)
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])


def writable(folder: Path) -> None:
    """Raise LumigraphError, naming this machine, unless a block's folder is seen from here and may be written."""
    if not (folder / "task.json").is_file():
        raise LumigraphError(
            f"{os.uname().nodename} does not see {folder}; give --output a folder on storage that all machines share"
        )
    if not os.access(folder, os.W_OK | os.X_OK):
        raise LumigraphError(
            f"{os.uname().nodename} may not write to {folder}; change its permissions there, or choose another --output"
        )
