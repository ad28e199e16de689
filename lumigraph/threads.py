"""Threads: how those that share a loop wait for each other. Settled before PyTorch and Numba load what runs them.

GNU's OpenMP lets a thread that has nothing to do look for work 300 000 times before it sleeps: some milliseconds. Alone
on the machine that saves waking it, which a training step would do dozens of times. Beside other programs a thread that
looks keeps the processor from the one that it waits for. Looking for about as long as the gaps between the loops of a
step last is nearly best in both (`benchmarks/busy.py`).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import MutableMapping

LOOKS = 40_000  # for work, before a thread sleeps: 0.2 to 2 ms, by processor
OWN = "OMP_WAIT_POLICY", "GOMP_SPINCOUNT"  # by which users say how threads wait


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
