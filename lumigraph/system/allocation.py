"""Allocation: how this process takes memory from the system, and when it gives it back.

A training step takes and gives back a hundred megabytes. GNU's C library asks the system for every large piece and
returns it at once, and the system fills each page with zeros again: a third of the processor time of a step of
Instant-NGP. So what is given back is kept, up to a limit, for the next step.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys

ARENA_MAX, MMAP_THRESHOLD, TRIM_THRESHOLD = -8, -3, -1  # mallopt's names for what follows
LARGE_BYTES = 256 << 20  # size of a piece that is requested from the system, and returned to it, by itself
KEPT_BYTES = 1 << 30  # that stay allocated after they are freed
USER_SETTINGS = {  # by which users, and programs, say so themselves
    ARENA_MAX: "MALLOC_ARENA_MAX",
    MMAP_THRESHOLD: "MALLOC_MMAP_THRESHOLD_",
    TRIM_THRESHOLD: "MALLOC_TRIM_THRESHOLD_",
}


def settle_memory() -> None:
    """Have all threads take their memory from one place, and keep there what they give back, unless the user's
    environment says how.

    GNU's C library gives every thread an arena of its own. What one has given back there, others cannot use: a process
    that opened six viewers one after the other held 130 MB of it. Ours are few, and ask for memory seldom.
    """
    if sys.platform != "linux" or "malloc" in os.environ.get("GLIBC_TUNABLES", ""):
        return
    with contextlib.suppress(AttributeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        for name, value in ((ARENA_MAX, 1), (MMAP_THRESHOLD, LARGE_BYTES), (TRIM_THRESHOLD, KEPT_BYTES)):
            if USER_SETTINGS[name] not in os.environ:
                mallopt(name, value)
