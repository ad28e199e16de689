"""Threads: how those that share a loop wait for each other.

GNU's OpenMP lets a thread that has nothing to do look for work 300 000 times before it sleeps: some milliseconds. Alone
on the machine that saves waking it, which a training step would do dozens of times. Beside other programs a thread that
looks keeps the processor from the one that it waits for. So threads look for that long, and hardly at all while others
hold them up (`benchmarks/busy.py`). A shorter look for all times costs too much: of a step of splatting with small
photographs, a sixth at 100 000 and a quarter at 40 000.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, MutableMapping
from functools import partial
from pathlib import Path

SPIN_COUNT = 300_000  # polls for work before a thread sleeps: some milliseconds
USER_SETTINGS = "OMP_WAIT_POLICY", "GOMP_SPINCOUNT"  # environment variables by which users set how threads wait
POLL_SECONDS = 0.5  # between measurements of contention
LINGER_SECONDS = 20.0  # after the last work, that contention is still measured
SLEEP_POLLS = 20  # measurements during which threads then sleep
MAX_WAITING_SHARE = 0.25  # of the time that our threads could run: above it other programs slow them down
MIN_RUNNING_SHARE = 0.1  # of the time: threads that run less do not wait for others
TASKS_FOLDER = Path("/proc/self/task")


def settle(environment: MutableMapping[str, str] = os.environ) -> None:
    """Say how long threads look for work, unless the user's environment says how they wait.

    It counts for libraries that are loaded afterwards: for PyTorch and Numba, or for Numba alone where PyTorch was
    imported before Lumigraph.
    """
    if not any(name in environment for name in USER_SETTINGS):
        environment["GOMP_SPINCOUNT"] = str(SPIN_COUNT)


def share_one_pool() -> None:
    """Have PyTorch and Numba use the same threads, where both run theirs by GNU's OpenMP.

    PyTorch brings a copy of the library, and Numba takes the system's. Each copy keeps threads of its own, and those of
    one look for work on the processors that the other's need. The copy that is loaded first serves both.
    """
    if sys.platform == "linux" and "torch" not in sys.modules:
        with contextlib.suppress(OSError):  # a system without it: Numba then has threads of another kind
            ctypes.CDLL("libgomp.so.1.0.0")


@contextlib.contextmanager
def considerate() -> Iterator[None]:
    """Inside this block, and for LINGER_SECONDS after the last such block, threads hardly look for work while other
    programs hold them up.

    Only where Linux tells so; a user's own way of waiting stays. Blocks may lie inside each other.
    """
    if not (TASKS_FOLDER / str(os.getpid()) / "schedstat").exists() or os.environ.get("GOMP_SPINCOUNT") != str(
        SPIN_COUNT
    ):
        yield
        return
    WATCH.enter()
    try:
        yield
    finally:
        WATCH.leave()


class ContentionWatch:
    """A thread that makes way for other programs while anybody works, and a little longer: work comes in short pieces,
    such as pictures."""

    def __init__(self) -> None:
        self._lock, self._over = threading.Lock(), threading.Event()
        self._thread: threading.Thread | None = None
        self._process, self._workers, self._left = 0, 0, 0.0

    @property
    def running(self) -> bool:
        """True while the thread of this process lives."""
        return self._thread is not None and self._thread.is_alive() and self._process == os.getpid()

    def enter(self) -> None:
        with self._lock:
            if self._process != os.getpid():  # a fork has neither the thread nor those who worked
                self._process, self._workers = os.getpid(), 0
                self._thread = None
                atexit.register(self.stop)  # Python that ends while a thread is inside PyTorch aborts
            self._workers += 1
            if not self.running or self._over.is_set():
                self._over = threading.Event()
                look = partial(self._held, self._over, Contention())
                self._thread = threading.Thread(
                    target=make_way, args=(self._over, look), name="considerate", daemon=True
                )
                self._thread.start()

    def leave(self) -> None:
        with self._lock:
            self._workers, self._left = self._workers - 1, time.monotonic()

    def stop(self) -> None:
        """End the thread, and wait for it."""
        self._over.set()
        if self.running and self._thread is not None:
            self._thread.join()

    def _held(self, over: threading.Event, contention: Callable[[], float]) -> float:
        """Share of the time in which others hold us up; without work for a while, 0, and it is over."""
        with self._lock:
            if self._workers == 0 and time.monotonic() > self._left + LINGER_SECONDS:
                over.set()
                return 0.0
        return contention()


WATCH = ContentionWatch()


class Contention:
    """Calling it tells the share of the time that our threads could have run, since the last call or since it was made,
    in which others had the processor."""

    def __init__(self) -> None:
        self._before = self._now()

    def __call__(self) -> float:
        now = self._now()
        pairs = [(before, now[name]) for name, before in self._before.items() if name in now]
        self._before = now
        ran, waited = (sum(after[i] - before[i] for before, after in pairs) for i in (0, 1))
        return waited / max(ran + waited, MIN_RUNNING_SHARE * POLL_SECONDS * 1e9, 1)

    @staticmethod
    def _now() -> dict[str, list[int]]:
        """Nanoseconds that each thread has run, and has waited for a processor."""
        found = {}
        for thread in TASKS_FOLDER.iterdir():
            with contextlib.suppress(OSError):  # a thread that has just ended
                found[thread.name] = [int(x) for x in (thread / "schedstat").read_text().split()[:2]]
        return found


def make_way(over: threading.Event, held: Callable[[], float]) -> None:
    """Until it is over: crowd our threads for a while whenever others hold them up.

    Whether others are still there shows best once threads look for work again: those that sleep may be woken on one
    processor, where they hold up each other.
    """
    crowding: tuple[threading.Thread, threading.Event] | None = None
    looks = 0
    while not over.wait(POLL_SECONDS):
        looks, share = looks + 1, held()
        if crowding is None and share > MAX_WAITING_SHARE and openmp_copies():
            leave, looks = threading.Event(), 0
            crowding = threading.Thread(target=crowd, args=(leave,), name="crowd", daemon=True), leave
            crowding[0].start()
        elif crowding is not None and looks >= SLEEP_POLLS:
            disperse(*crowding)
            crowding = None
    if crowding is not None:
        disperse(*crowding)


def disperse(thread: threading.Thread, leave: threading.Event) -> None:
    """Let the crowd go, and wait until it is gone: Python that ends while a thread is inside PyTorch aborts."""
    leave.set()
    thread.join()


def crowd(leave: threading.Event) -> None:
    """Hold a second set of threads in each copy of OpenMP, which sleep. For OpenMP they are more than there are
    processors, and then every thread looks for work a hundred times only (GOMP_SPINCOUNT in the manual of GNU's
    libgomp)."""
    for openmp in openmp_copies():
        openmp.GOMP_parallel(openmp.omp_get_thread_num, None, processors(), 0)  # each thread asks for its number
    leave.wait()


def openmp_copies() -> list[ctypes.CDLL]:
    """Copies of GNU's OpenMP in this process: one, or two where PyTorch was imported before Lumigraph."""
    lines = Path("/proc/self/maps").read_text().splitlines()
    paths = {line.split(maxsplit=5)[-1] for line in lines if "/libgomp" in line}
    return [ctypes.CDLL(path) for path in sorted(paths) if Path(path).exists()]  # an update may have removed one


def description() -> str:
    """Describe the number of threads, and the load of the last minute if it exceeds the processors."""
    import torch

    count = torch.get_num_threads()
    threads = f"{count} thread" + "s" * (count > 1)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    return f"{threads}, on a machine that is busy (load {load:.1f})" if load > processors() else threads


def processors() -> int:
    """Number of processors available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
