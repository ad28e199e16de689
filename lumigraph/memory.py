"""Memory: how much this process has needed, how much more there is, and how much images may take."""

from __future__ import annotations

import importlib
import os
import re
import sys
from contextlib import suppress
from pathlib import Path

import torch

STATUS = Path("/proc/self/status")
SPARED = 0.3  # of what is free now, for everybody else
IMAGES = 0.4  # share of the machine's memory that images may take; the rest is for training and all else that runs
LIMITS = (  # of a container, and what it uses of it
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


def peak_memory(device: torch.device) -> int:
    """Bytes that this process has held at most: of a GPU what tensors took there, otherwise resident main memory.

    0 where the system does not tell.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    if STATUS.exists():  # getrusage would count the process that started this one too
        found = re.search(r"VmHWM:\s*(\d+) kB", STATUS.read_text())
        return 1024 * int(found[1]) if found else 0
    if sys.platform == "win32":
        return 0
    resource = importlib.import_module("resource")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def room_for(size: int, device: torch.device) -> int:
    """How many more things of so many bytes may be made on a device; very many where the system does not say."""
    if device.type == "cuda":
        free = torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device)
        free -= torch.cuda.memory_allocated(device)
    else:
        free = free_memory()
    return int((1 - SPARED) * free) // size


def free_memory() -> int:
    """Bytes that a program may still have: the machine's, or what is left of a container's limit."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            known = dict(line.split(":") for line in file)
        free = 1024 * int(known["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return 1 << 50
    for limit, used in LIMITS:
        try:
            with open(limit, encoding="ascii") as most, open(used, encoding="ascii") as now:
                free = min(free, int(most.read()) - int(now.read()))
        except (OSError, ValueError):
            continue
    return max(free, 0)


def memory_for_images() -> int:
    """Bytes of images to keep in memory: a share of the machine's, or of what a container allows."""
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        total = 8 << 30
    for limit, _ in LIMITS:
        with suppress(OSError, ValueError):  # no container, or no limit
            total = min(total, int(Path(limit).read_text()))
    return int(IMAGES * total)
