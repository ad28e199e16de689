"""Train all blocks of a run, in this process one after another or on Ray's workers; then align their appearances, or
merge their clouds. Retrain one block on other photographs.

Workers are on this machine, or on a cluster with shared storage. Only a block's path is sent, and a few numbers are
returned: workers read photographs and write states on the shared storage. So a worker, a machine or this process may
fail at any time; training continues from the saved states.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .. import files, methods
from ..components.fields.appearance import Appearance
from ..datasets.scene import Scene
from ..errors import LumigraphError
from ..exchange import write_gaussians
from ..files import scene_name
from ..files.locks import lock_folder
from ..files.names import discard, next_free
from ..method.capabilities import HasGaussians, can
from ..opening import kind_of
from ..readers import Places
from ..system.memory import free_memory
from ..system.signals import Interrupt
from ..training.options import BlockOptions, TrainOptions
from .alignment import align_appearance
from .block_cache import Nearby
from .block_run import BlockRun
from .layout import MIN_LARGE_VIEWS, Disc, members
from .monitor import Watching, in_order
from .plan import DONE_FILE, PLAN_FILE, TASK_FILE, Block, Done, Plan, Task, source_of
from .planning import SCENE_OPTIONS, begin, difference, make_plan, place_of, survey, write_task
from .worker import Conducted, Ended, finished, train_block, writable

CLOUD_FILE = "cloud.ply"
UPDATES_FOLDER = "updates"  # in the run: a block is trained there before it replaces the old one
INSTALL_MESSAGE = "Ray is not installed, which shares blocks out to workers: pip install 'lumigraph[ray]', or leave out"
MAX_LOSSES = 30  # of a block's worker, before the block is given up
ADDRESS_TIMEOUT = 10.0  # seconds
POLL_SECONDS = 0.5  # between checks for a stop
END_SECONDS = 90.0  # for workers to finish their step and save after a stop
STORE_BYTES = 100 << 20  # of Ray's object store on this machine: results are small
RAY_ENVIRONMENT = {  # that Ray reads as it is loaded, unless the user's environment has them
    "RAY_USAGE_STATS_ENABLED": "0",  # no reports
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_worker_niceness": "0",  # else workers get next to nothing of a busy machine
}


def conduct(run: Path, plan: Plan, workers: Workers, show: bool = True) -> Conducted:
    """Train all unfinished blocks of a run.

    A block's failure does not affect the others. Raises LumigraphError where another process works in the run, and for
    unavailable workers.
    """
    folders = {block.name: place_of(run, block) for block in plan.blocks}
    with lock_folder(run, "trained"), Watching(run, folders, show):
        if workers.count is not None or workers.address is not None:
            return on_workers(folders, workers)
        found = Conducted({}, {})
        for name in in_order(folders):  # in this process
            try:
                ended = train_block(folders[name])
            except LumigraphError as fault:
                found.failed[name] = str(fault)
                continue
            if ended.done is None:
                return replace(found, signal=ended.signal)
            found.done[name] = ended.done
        return found


def finish(folder: Path, again: Sequence[str] = ()) -> Plan:
    """Align the blocks' appearances and write their codes into blocks.json; for clouds, write the merged cloud.

    again: names of retrained blocks, which are aligned to the others
    Returns the resulting plan. Finished steps are not repeated.
    """
    opened = BlockRun(folder)
    first = opened.placed(opened.blocks[0]).method
    if Appearance in first.takes:
        return aligned(opened, again)
    if can(first, HasGaussians):
        write_gaussians(folder / CLOUD_FILE, opened.source_gaussians())
    return opened.plan


def aligned(opened: BlockRun, again: Sequence[str]) -> Plan:
    """Plan with an appearance code for every block; known ones stay unchanged (Tancik 2022, 4.3.3)."""
    names = [block.name for block in opened.blocks]
    known = {name: code for name, code in opened.plan.appearance.items() if name not in again}
    if all(name in known for name in names):
        return opened.plan
    opened.plan = replace(opened.plan, appearance=known)
    parts = Nearby(lambda i: opened.placed(opened.blocks[i]), len(names))
    kept = [i for i, name in enumerate(names) if name in known]
    codes = align_appearance(parts, opened.centres, opened.radii, opened.cameras()["train"], kept or None)
    found = {name: code.tolist() for name, code in zip(names, codes, strict=True)}
    plan = replace(opened.plan, appearance=found | known)
    plan.write(opened.folder / PLAN_FILE)
    return plan


def update(run: Path, source: str, train: TrainOptions, blocks: BlockOptions, show: bool = True) -> Ended:
    """Learn a block of a run again, put it into its place, and align it to its neighbours.

    source: of the new photographs, in the frame of the old ones
    The new block replaces the old one when it is done; an interrupted update continues. Files of other blocks stay.
    Raises LumigraphError for an unknown block, and where no photograph is of it.
    """
    if (name := blocks.blocks) is None or not name.isdigit():
        raise LumigraphError("--into needs the name of the block to learn again; give it as --blocks 3")
    if not files.is_file(run / PLAN_FILE):
        raise LumigraphError(f"{run} holds no run in blocks; give --into one that `lumigraph train block-nerf` made")
    with lock_folder(run, "trained"):
        plan = Plan.read(run / PLAN_FILE)
        block = again(plan.block(name), source, train)
        task, place = plan.task(block), place_of(run, block)
        if not ((place / TASK_FILE).exists() and Task.read(place).key == task.key and finished(place, task)):
            folder = run / UPDATES_FOLDER / f"{name}-{task.key[:8]}"
            write_task(folder, task)
            with Watching(run, {name: folder}, show):
                ended = train_block(folder)
            if ended.done is None:
                return ended
            files.exchange(folder, place)
            shutil.rmtree(folder, ignore_errors=True)  # what was there before
        replace(plan, blocks=[block if one.name == name else one for one in plan.blocks]).write(run / PLAN_FILE)
        finish(run, again=[name])
    return Ended(finished(place, task))


def again(block: Block, source: str, train: TrainOptions) -> Block:
    """The block as it will learn from other photographs, by the budget of the options, or the one that it had."""
    places = survey(source, train.reader)
    options = {name: getattr(train, name) for name in SCENE_OPTIONS}
    chosen = members(places, Disc(block.centre, block.radius))
    learnt = np.array([split == "train" for split in places.splits])
    if (chosen & learnt).sum() < 2:
        raise LumigraphError(
            f"{source} has fewer than two photographs to learn from within block {block.name}; their poses must be in "
            "the frame of the run's own photographs, so capture them together with some of those"
        )
    names = [places.names[i] for i in np.flatnonzero(chosen)]
    told = train.budget.to_json() if train.budget else block.budget
    return replace(block, photographs=names, scene=source_of(source, options), budget=told)


@dataclass(frozen=True)
class Workers:
    """Workers that train blocks.

    count:   blocks at a time on this machine, each in its own process; None for this process alone
    address: of a running Ray cluster, HOST:PORT
    cpus, gpus, memory: demand of a block: processors, GPUs, bytes
    """

    count: int | None = None
    address: str | None = None
    cpus: int = 1
    gpus: float = 0.0
    memory: int = 2 << 30


def on_workers(folders: dict[str, Path], workers: Workers) -> Conducted:
    """Train blocks on workers. Raises LumigraphError without Ray, and if the address does not answer."""
    ray = library("--workers" if workers.address is None else "--address")
    with connected(ray, workers), Interrupt() as interrupt:
        feasible(ray.nodes(), workers)
        demand = {"num_cpus": workers.cpus, "num_gpus": workers.gpus, "memory": workers.memory}
        remote = ray.remote(**demand, max_retries=MAX_LOSSES)(on_worker)
        own = methods.loaded_here()
        waiting = {remote.remote(str(folders[name].resolve()), own): name for name in in_order(folders)}
        done: dict[str, Done] = {}
        failed: dict[str, str] = {}
        told_at = 0.0
        while waiting:
            ready, _ = ray.wait(list(waiting), num_returns=1, timeout=POLL_SECONDS)
            for one in ready:
                name = waiting.pop(one)
                try:
                    found = ray.get(one)
                except ray.exceptions.TaskCancelledError:
                    continue
                except ray.exceptions.RayError as fault:
                    failed[name] = sentence(fault)
                    continue
                if isinstance(found, Done):
                    done[name] = found
                elif found is not None:
                    failed[name] = found
            if interrupt.signal and not told_at:
                told_at = time.monotonic()
                for one in waiting:
                    ray.cancel(one, force=False)
            if told_at and time.monotonic() > told_at + END_SECONDS:
                break
    return Conducted(done, failed, interrupt.signal)


def on_worker(folder: str, method_files: Sequence[str] = ()) -> Done | str | None:
    """Train a block on a worker. Returns its cost, a sentence if it failed, None if it was stopped.

    method_files: of external methods, on the shared storage
    """
    with contextlib.redirect_stderr(sys.stdout):
        try:
            for file in method_files:
                methods.load(file)
            writable(Path(folder))
            return train_block(Path(folder)).done
        except LumigraphError as fault:
            return str(fault)


@contextlib.contextmanager
def connected(ray: Any, workers: Workers) -> Iterator[None]:
    """Block with a connection to a Ray cluster: a new one on this machine, or a running one."""
    if workers.address is not None:
        answering(workers.address)
        place: dict[str, Any] = {"address": workers.address}
    else:
        cpus = workers.cpus * (workers.count or 1)
        place = {"num_cpus": cpus, "object_store_memory": STORE_BYTES, "include_dashboard": False}
    try:
        ray.init(**place, logging_level="error", log_to_driver=False)
    except (ConnectionError, RuntimeError, ValueError, TimeoutError) as fault:
        where = workers.address or "this machine"
        raise LumigraphError(
            f"Ray on {where} could not be used ({first_line(fault)}); look at `ray status`, and where the cluster asks "
            "for a token, set RAY_AUTH_MODE=token here as well"
        ) from fault
    try:
        yield
    finally:
        ray.shutdown()


def feasible(nodes: list[dict[str, Any]], workers: Workers) -> None:
    """Raise LumigraphError unless some machine of the cluster meets a block's demand; Ray would wait for ever."""
    asked = {"CPU": workers.cpus, "GPU": workers.gpus, "memory": workers.memory}
    there = [node["Resources"] for node in nodes if node.get("Alive")]
    if not any(all(node.get(name, 0) >= least for name, least in asked.items()) for node in there):
        raise LumigraphError(
            f"No machine of the cluster has what a block asks for ({workers.cpus} processors, {workers.gpus:g} GPUs, "
            f"{workers.memory / 1e9:.1f} GB of memory); start one that has, by `ray start`"
        )


def library(option: str) -> Any:
    """Import Ray. Raises LumigraphError, with the command to install it, if it is missing."""
    for name, value in RAY_ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    try:
        import ray
    except ImportError as fault:
        raise LumigraphError(f"{INSTALL_MESSAGE} {option} to learn block after block in this process") from fault
    return ray


def answering(address: str) -> None:
    """Raise LumigraphError unless HOST:PORT accepts connections."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdigit()):
        raise LumigraphError(f"--address {address} is no HOST:PORT; `ray start --head` says which it is")
    try:
        socket.create_connection((host, int(port)), ADDRESS_TIMEOUT).close()
    except (OSError, OverflowError) as fault:
        raise LumigraphError(
            f"Nothing answers at {address} ({first_line(fault)}); start a cluster there with `ray start --head "
            f"--port={port}`, or correct --address"
        ) from fault


def sentence(fault: BaseException) -> str:
    """One sentence on a block's failure."""
    if "OutOfMemory" in type(fault).__name__:
        return "its worker ran out of memory again and again; give smaller blocks, or fewer --workers"
    return f"its worker was lost {MAX_LOSSES} times or failed ({first_line(fault)})"


def first_line(fault: BaseException) -> str:
    lines = [line.strip() for line in str(fault).splitlines() if line.strip()]
    return (lines[-1] if lines else type(fault).__name__).rstrip(".")


MEMORY_BYTES = 2 << 30  # bytes reserved for a block


def places_in_blocks(source: str, train: TrainOptions, blocks: BlockOptions) -> Places | None:
    """Positions of the photographs of a scene that is learnt in blocks; None for one that is learnt as a whole."""
    if kind_of(source, Scene) is not Scene or Path(source).is_file() or (blocks.blocks == "1" and not blocks.field):
        return None  # a file is a single picture
    places = survey(source, train.reader)
    few = places.splits.count("train") < MIN_LARGE_VIEWS
    if few and not blocks.field and (blocks.blocks, blocks.workers, blocks.address) == (None, None, None):
        return None
    for name in ("view", "pause_at", "views", "depth_from"):
        if getattr(train, name, None):
            raise LumigraphError(f"--{name.replace('_', '-')} is for one block; leave it out, or give --blocks 1")
    return places


def begin_blocks(
    source: str,
    places: Places,
    method: str,
    config: Any,
    device: torch.device,
    train: TrainOptions,
    blocks: BlockOptions,
    output: Path | None = None,
) -> tuple[Path, Plan, Workers]:
    """Begin a run in blocks, or go on with the latest one of the same plan. Returns its folder, plan and workers.

    config: of the method of the blocks, which is the user's unless the options name another
    """
    learner, here = methods.check(blocks.field or method), blocks.address is None
    plan = make_plan(source, places, learner, config, train, blocks, str(device))
    folder = output or unfinished(f"runs/{scene_name(source)}-{methods.check(method)}", plan)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = blocks.workers
    cpus = max(1, cores // count) if count else 1
    plan = begin(folder, plan, places, None if here and count is None else cpus)
    memory = min(MEMORY_BYTES, free_memory() // (2 * count)) if here and count else MEMORY_BYTES
    return folder, plan, Workers(count, blocks.address, cpus, 1.0 if device.type == "cuda" else 0.0, memory)


def unfinished(prefix: str, plan: Plan) -> Path:
    """The latest run of this name, if it is the same and not done; else the next name that is free."""
    free = next_free(prefix)
    number = int(free.name.rpartition("-")[2])
    latest = free.with_name(f"{free.name.rpartition('-')[0]}-{number - 1}")
    if (latest / PLAN_FILE).is_file() and difference(known := Plan.read(latest / PLAN_FILE), plan) is None:
        if not all((place_of(latest, block) / DONE_FILE).exists() for block in known.blocks):
            discard(free)
            return latest
    return free
