"""Threads: spin-waiting of OpenMP threads.

GNU's OpenMP lets an idle thread spin 300 000 times before it sleeps: some milliseconds. On an idle machine that saves
waking it, dozens of times in a training step. Beside other programs a spinning thread takes the processor from the one
that it waits for. So threads spin that long, and hardly at all while other programs compete (`benchmarks/busy.py`). A
shorter spin at all times costs too much: of a step of splatting with small photographs, a sixth at 100 000 and a
quarter at 40 000.
"""

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
    """Set the spin count of threads, unless the environment sets their wait policy.

    It applies to libraries that are loaded afterwards: to PyTorch and Numba, or to Numba alone where PyTorch was
    imported before Lumigraph. Numba prefers OpenMP to TBB, which some package may have brought: that would be a second
    pool, and at exit it waits for its threads, for minutes on a loaded machine.
    """
    environment.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")
    if not any(name in environment for name in USER_SETTINGS):
        environment["GOMP_SPINCOUNT"] = str(SPIN_COUNT)


def share_one_pool() -> None:
    """Make PyTorch and Numba use one thread pool, where both use GNU's OpenMP.

    PyTorch brings a copy of the library, and Numba takes the system's. Each copy has a pool of its own, and idle
    threads of one spin on the processors that the other needs. The copy that is loaded first serves both.
    """
    if sys.platform == "linux" and "torch" not in sys.modules:
        with contextlib.suppress(OSError):  # a system without it: Numba then has threads of another kind
            ctypes.CDLL("libgomp.so.1.0.0")


@contextlib.contextmanager
def considerate() -> Iterator[None]:
    """Block in which, and for LINGER_SECONDS after which, threads hardly spin while other programs compete for
    processors.

    Only on Linux, which reports contention; the user's own wait policy is kept. Blocks may be nested.
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
    """Thread that reduces spinning under contention during work, and a little longer, for work in short pieces."""

    def __init__(self) -> None:
        self._lock, self._over = threading.Lock(), threading.Event()
        self._thread: threading.Thread | None = None
        self._process, self._workers, self._left = 0, 0, 0.0

    @property
    def running(self) -> bool:
        """True while this process's thread runs."""
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
                look = partial(self._measure_contention, self._over, Contention())
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

    def _measure_contention(self, over: threading.Event, contention: Callable[[], float]) -> float:
        """Share of the time that our threads waited for a processor; after a while without work 0, with `over` set."""
        with self._lock:
            if self._workers == 0 and time.monotonic() > self._left + LINGER_SECONDS:
                over.set()
                return 0.0
        return contention()


WATCH = ContentionWatch()


class Contention:
    """Contention meter: each call returns the share of runnable time since the last one lost to other programs."""

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
    """Until `over` is set: oversubscribe threads for a while whenever there is contention.

    Contention is measured best while threads spin: sleeping ones may be woken on one processor, where they delay each
    other.
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
    """End the extra threads and wait for them: Python aborts if it exits while a thread is inside PyTorch."""
    leave.set()
    thread.join()


def crowd(leave: threading.Event) -> None:
    """Start a second, sleeping pool in each copy of OpenMP. It then counts more threads than processors, and every
    thread spins only a hundred times (GOMP_SPINCOUNT in the manual of GNU's libgomp)."""
    for openmp in openmp_copies():
        openmp.GOMP_parallel(openmp.omp_get_thread_num, None, processors(), 0)  # each thread asks for its number
    leave.wait()


def openmp_copies() -> list[ctypes.CDLL]:
    """Loaded copies of GNU's OpenMP: one, or two where PyTorch was imported before Lumigraph."""
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
