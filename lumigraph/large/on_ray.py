"""Blocks on the workers of Ray: on this machine, or on a cluster with storage that all its machines share.

A block goes out as a path and comes back as a few numbers: photographs are read where they are learnt from, and states
are files. So a worker, a machine or this process may be lost at any time; what was saved is gone on with.
"""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import LumigraphError
from ..system.allocation import settle_memory
from ..system.signals import Interrupt
from .monitor import in_order
from .plan import Done
from .worker import Conducted, train_block, writable

INSTALL_MESSAGE = "Ray is not installed, which shares blocks out to workers: pip install 'lumigraph[ray]', or leave out"
MAX_LOSSES = 30  # of a block's worker, before the block is given up
ADDRESS_TIMEOUT = 10.0  # seconds
POLL_SECONDS = 0.5  # between checks for a stop
END_SECONDS = 90.0  # for workers to finish their step and save after a stop
STORE_BYTES = 100 << 20  # of Ray's object store on this machine: results are small
RAY_ENVIRONMENT = {  # that Ray reads as it is loaded, unless the user's environment has them
    "RAY_USAGE_STATS_ENABLED": "0",  # nobody is told
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_worker_niceness": "0",  # else workers get next to nothing of a busy machine
}


@dataclass(frozen=True)
class Workers:
    """Workers that train blocks.

    count:   blocks at a time on this machine, each in a process of its own; None for this process alone
    address: of a Ray cluster that is there already, HOST:PORT
    cpus, gpus, memory: what a block asks of its machine: processors, GPUs, bytes
    """

    count: int | None = None
    address: str | None = None
    cpus: int = 1
    gpus: float = 0.0
    memory: int = 2 << 30


def on_workers(run: Path, folders: dict[str, Path], workers: Workers) -> Conducted:
    """Learn blocks on workers. Raises LumigraphError where Ray is not there, or nothing answers at the address."""
    ray = library("--workers" if workers.address is None else "--address")
    with connected(ray, workers), Interrupt() as interrupt:
        feasible(ray.nodes(), workers)
        asked = {
            "num_cpus": workers.cpus,
            "num_gpus": workers.gpus,
            "memory": workers.memory,
            "max_retries": MAX_LOSSES,
        }
        remote = ray.remote(**asked)(on_worker)
        waiting = {remote.remote(str(folders[name].resolve())): name for name in in_order(folders)}
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


def on_worker(folder: str) -> Done | str | None:
    """Train a block on a worker. Returns what it took, a sentence if it failed, None if it was stopped."""
    settle_memory()
    with contextlib.redirect_stderr(sys.stdout):
        try:
            writable(Path(folder))
            return train_block(Path(folder)).done
        except LumigraphError as fault:
            return str(fault)


@contextlib.contextmanager
def connected(ray: Any, workers: Workers) -> Iterator[None]:
    """A cluster: one on this machine for as long as the block lasts, or one that is there already."""
    quiet: dict[str, Any] = {"logging_level": "error", "log_to_driver": False}
    if workers.address is not None:
        answering(workers.address)
        place: dict[str, Any] = {"address": workers.address}
    else:
        place = {
            "num_cpus": workers.cpus * (workers.count or 1),
            "object_store_memory": STORE_BYTES,
            "include_dashboard": False,
        }
    try:
        ray.init(**place, **quiet)
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
    """Raise LumigraphError unless some machine of the cluster has what a block asks for; Ray would wait for one."""
    asked = {"CPU": workers.cpus, "GPU": workers.gpus, "memory": workers.memory}
    there = [node["Resources"] for node in nodes if node.get("Alive")]
    if not any(all(node.get(name, 0) >= least for name, least in asked.items()) for node in there):
        raise LumigraphError(
            f"No machine of the cluster has what a block asks for ({workers.cpus} processors, {workers.gpus:g} GPUs, "
            f"{workers.memory / 1e9:.1f} GB of memory); start one that has, by `ray start`"
        )


def library(option: str) -> Any:
    """Ray itself. Raises LumigraphError, saying how to install it, where it is not."""
    for name, value in RAY_ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    try:
        import ray
    except ImportError as fault:
        raise LumigraphError(f"{INSTALL_MESSAGE} {option} to learn block after block in this process") from fault
    return ray


def answering(address: str) -> None:
    """Raise LumigraphError unless something listens at HOST:PORT."""
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
    """Why a block was given up."""
    if "OutOfMemory" in type(fault).__name__:
        return "its worker ran out of memory again and again; give smaller blocks, or fewer --workers"
    return f"its worker was lost {MAX_LOSSES} times or failed ({first_line(fault)})"


def first_line(fault: BaseException) -> str:
    lines = [line.strip() for line in str(fault).splitlines() if line.strip()]
    return (lines[-1] if lines else type(fault).__name__).rstrip(".")
