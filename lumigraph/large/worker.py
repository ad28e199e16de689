"""Train one block of a large scene: a restartable function of the block's folder.

    RUN/blocks/3/
    ├── task.json     complete description of the training
    ├── config.json, cameras.json, checkpoints/, metrics.jsonl ...   an ordinary run
    └── done.json     last, with a hash of the task

A finished block is skipped, a block with a state continues, any other begins. So the call may be repeated after the
loss of a process or a machine.
"""

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
from ..files.locks import lock_folder
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
    """Result of a call: the block's cost, or the signal that stopped it."""

    done: Done | None
    signal: int | None = None


@dataclass(frozen=True)
class Conducted:
    """Result of all blocks: costs by name, a sentence for each that failed, and the signal that stopped it."""

    done: dict[str, Done]
    failed: dict[str, str]
    signal: int | None = None


def train_block(folder: Path, save_every: float = SAVE_SECONDS) -> Ended:
    """Train a block by its task.json, unless it is finished.

    With a budget in steps, interruptions do not change the weights by a bit on a CPU. Ctrl-C and SIGTERM save. Raises
    LumigraphError for an invalid task, and for a folder that is not writable.
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
    """Cost of a finished block, else None. Raises LumigraphError for one finished with another task."""
    if not (folder / DONE_FILE).exists():
        return None
    done: Done = files.read_json(folder / DONE_FILE, Done)
    if done.key != task.key:
        raise LumigraphError(
            f"{folder} was trained for other settings than its task.json says; choose another --output"
        )
    return done


def opened(task: Task) -> Scene:
    """Open the photographs of a block, in its own frame, with the orientation common to all."""
    options = {name: value for name, value in task.scene.options.items() if value is not None}
    before = Before(options["part"]["photographs"], np.array(task.upright))
    data = open_dataset(task.scene.source, Scene, **options, memory=task.memory, before=before)
    assert isinstance(data, Scene)
    return data


def begun(folder: Path, task: Task, data: Scene) -> tuple[Run, Method]:
    """The run in a block's folder and its method, at its saved state. Raises LumigraphError for another task's run."""
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
    """Lock a block's folder; wait a while for a process that is ending. Raises LumigraphError if it stays locked."""
    until = time.monotonic() + LOCK_TIMEOUT
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(lock_folder(folder, "trained"))
                break
            except LumigraphError:
                if time.monotonic() > until:
                    raise
                time.sleep(0.5)
        yield


@contextmanager
def limited(threads: int | None) -> Iterator[None]:
    """Block with a number of PyTorch and Numba threads; None keeps it."""
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
    """Raise LumigraphError, naming this machine, unless a block's folder exists here and is writable."""
    if not (folder / "task.json").is_file():
        raise LumigraphError(
            f"{os.uname().nodename} does not see {folder}; give --output a folder on storage that all machines share"
        )
    if not os.access(folder, os.W_OK | os.X_OK):
        raise LumigraphError(
            f"{os.uname().nodename} may not write to {folder}; change its permissions there, or choose another --output"
        )
