"""Allocation: memory of this process between training steps.

A training step allocates and frees a hundred megabytes. GNU's C library requests every large block from the system and
returns it at once, and the system zeroes each page again: a third of the processor time of a step of Instant-NGP. So
freed memory is kept, up to a limit, for the next step.
"""

import contextlib
import ctypes
import gc
import os
import sys
from functools import cache

ARENA_MAX, MMAP_THRESHOLD, TRIM_THRESHOLD = -8, -3, -1  # mallopt's names for what follows
LARGE_BYTES = 256 << 20  # size of a piece that is requested from the system, and returned to it, by itself
KEPT_BYTES = 1 << 30  # that stay allocated after they are freed
USER_SETTINGS = {  # by which users, and programs, say so themselves
    ARENA_MAX: "MALLOC_ARENA_MAX",
    MMAP_THRESHOLD: "MALLOC_MMAP_THRESHOLD_",
    TRIM_THRESHOLD: "MALLOC_TRIM_THRESHOLD_",
}


@cache
def settle_memory() -> None:
    """Let all threads of the process allocate from one arena and keep freed memory there, unless the environment
    overrides it.

    GNU's C library gives every thread an arena of its own, whose freed memory others cannot use: a process that opened
    six viewers one after the other kept 130 MB of it. Our threads are few and allocate seldom.
    """
    if sys.platform != "linux" or "malloc" in os.environ.get("GLIBC_TUNABLES", ""):
        return
    with contextlib.suppress(AttributeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        for name, value in ((ARENA_MAX, 1), (MMAP_THRESHOLD, LARGE_BYTES), (TRIM_THRESHOLD, KEPT_BYTES)):
            if USER_SETTINGS[name] not in os.environ:
                mallopt(name, value)


def give_back_memory() -> None:
    """Return freed memory to the system, after work that needed much."""
    gc.collect()
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):  # another C library
            ctypes.CDLL(None).malloc_trim(0)
