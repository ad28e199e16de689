"""Threads: how those that share a loop wait for each other.

GNU's OpenMP lets a thread that has nothing to do look for work 300 000 times before it sleeps: some milliseconds. Alone
on the machine that saves waking it, which a training step would do dozens of times. Beside other programs a thread that
looks keeps the processor from the one that it waits for. So threads look for about as long as the gaps between the
loops of a step last, and hardly at all while others want the processors (`benchmarks/busy.py`).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, MutableMapping
from pathlib import Path

LOOKS = 40_000  # for work, before a thread sleeps: 0.2 to 2 ms, by processor
OWN = "OMP_WAIT_POLICY", "GOMP_SPINCOUNT"  # by which users say how threads wait
EVERY = 0.5  # seconds between looks at what others do
TAKEN = 0.3  # processors that others may use of those that our threads need
ALL = Path("/proc/stat")


def settle(environment: MutableMapping[str, str] = os.environ) -> None:
    """Bound how long threads look for work, unless the user's environment says how they wait.

    It counts for libraries that are loaded afterwards: for PyTorch and Numba, or for Numba alone where PyTorch was
    imported before Lumigraph.
    """
    if not any(name in environment for name in OWN):
        environment["GOMP_SPINCOUNT"] = str(LOOKS)


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
    """Inside this block threads hardly look for work while other programs use the processors that they need.

    Only where Linux tells what others use; a user's own way of waiting stays, which `settle` has not set.
    """
    if not ALL.exists() or os.environ.get("GOMP_SPINCOUNT") != str(LOOKS):
        yield
        return
    over = threading.Event()
    watch = threading.Thread(target=make_way, args=(over, Others()), name="others", daemon=True)
    watch.start()
    try:
        yield
    finally:
        over.set()
        watch.join()


class Others:
    """Calling it tells how many processors other processes used since the last call, or since it was made."""

    def __init__(self) -> None:
        self._before = self._now()

    def __call__(self) -> float:
        now = self._now()
        clock, all_of_us, ours = (b - a for a, b in zip(self._before, now, strict=True))
        self._before = now
        return max(0.0, all_of_us - ours) / max(clock, 1e-3)

    @staticmethod
    def _now() -> tuple[float, float, float]:
        """Seconds: of the clock, of all processors at work, of this process at work."""
        spent = [int(x) for x in ALL.read_text().partition("\n")[0].split()[1:9]]
        idle = spent[3] + spent[4]  # waiting for a disk is idle
        return time.monotonic(), (sum(spent) - idle) / os.sysconf("SC_CLK_TCK"), time.process_time()


def make_way(over: threading.Event, others: Callable[[], float]) -> None:
    """Until it is over: crowd our threads while others use the processors that they need."""
    stay: threading.Event | None = None
    while not over.wait(EVERY):
        used, torch = others(), sys.modules.get("torch")
        if torch is None or not hasattr(torch, "get_num_threads"):  # not loaded yet
            continue
        crowded = used > (os.cpu_count() or 1) - torch.get_num_threads() + TAKEN
        if crowded and stay is None:
            stay = threading.Event()
            threading.Thread(target=crowd, args=(stay,), name="crowd", daemon=True).start()
        elif not crowded and stay is not None:
            stay.set()
            stay = None
    if stay is not None:
        stay.set()


def crowd(leave: threading.Event) -> None:
    """Hold a second set of threads, which sleep. For OpenMP they are more than there are processors, and then every
    thread looks for work a hundred times only (GOMP_SPINCOUNT in the manual of GNU's libgomp)."""
    import torch

    torch.ones(1 << 18).exp_()
    leave.wait()


def told() -> str:
    """How many threads share the work; and the load of the last minute, where it is more than the processors can do."""
    import torch

    count = torch.get_num_threads()
    threads = f"{count} thread" + "s" * (count > 1)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    return f"{threads}, on a machine that is busy (load {load:.1f})" if load > processors() else threads


def processors() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
