"""Memory: how much this process has needed, how much more there is, and how much images may take."""

from __future__ import annotations

import importlib
import os
import re
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import torch

from ..errors import LumigraphError

STATUS_FILE = Path("/proc/self/status")
SPARED_SHARE = 0.3  # of free memory, left to other programs
IMAGES_SHARE = 0.4  # of the machine's memory that images may take; the rest is for training and other programs
BYTES_PER_PIXEL = 128  # while a picture is rendered: ray, colour, depth and opacity, in parts and in total
MEMORY_FAULTS = (
    "can't allocate memory",
    "bad_alloc",
    "Storage size calculation overflowed",
    "Cannot allocate memory",
)
UNITS = {unit: 1024**power for power, unit in enumerate("bKMGTPE")}
CONTAINER_LIMITS = (  # files with the limit of a container, and its use
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


def peak_memory(device: torch.device) -> int:
    """Bytes that this process has held at most: of a GPU what tensors took there, otherwise resident main memory.

    0 where the system does not tell.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    if STATUS_FILE.exists():  # getrusage would count the process that started this one too
        found = re.search(r"VmHWM:\s*(\d+) kB", STATUS_FILE.read_text())
        return 1024 * int(found[1]) if found else 0
    if sys.platform == "win32":
        return 0
    resource = importlib.import_module("resource")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def room_for(size: int, device: torch.device) -> int:
    """Number of further objects of a size in bytes that fit on a device; very large if free memory is unknown."""
    return int((1 - SPARED_SHARE) * free_on(device)) // size


def free_on(device: torch.device) -> int:
    """Bytes that may still be had on a device."""
    if device.type != "cuda":
        return free_memory()
    reserved = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return torch.cuda.mem_get_info(device)[0] + reserved


def ask_for(size: int, device: torch.device, what: str, remedy: Callable[[], str] | str) -> None:
    """Raise LumigraphError unless so many bytes may be had on a device. what: needs them; remedy: needs less"""
    if size > (free := free_on(device)):
        less = remedy if isinstance(remedy, str) else remedy()
        raise LumigraphError(f"{what} would need {gigabytes(size)} of memory, and {gigabytes(free)} are free; {less}")


def ask_for_picture(width: int, height: int, device: torch.device) -> None:
    """Raise LumigraphError unless a rendering of so many pixels may be had on a device."""
    what = f"A picture of {width} x {height} pixels"
    ask_for(BYTES_PER_PIXEL * width * height, device, what, "give a smaller --size")


def gigabytes(size: float) -> str:
    """Bytes for people: "0.3 GB", "1,234 GB"."""
    return f"{size / 1e9:,.1f} GB" if size < 1e11 else f"{size / 1e9:,.0f} GB"


def want_of_memory(error: BaseException) -> str | None:
    """One sentence for a fault that is for want of memory: what asked for how much. None for any other fault."""
    told = str(error)
    if not (isinstance(error, MemoryError | torch.OutOfMemoryError) or any(sign in told for sign in MEMORY_FAULTS)):
        return None
    asked = re.search(r"allocate ([\d.]+) ?(bytes|[KMGTPE]iB)", told)
    amount = "more" if asked is None else gigabytes(float(asked[1]) * UNITS[asked[2][0]])
    frames = [x.name for x in traceback.extract_tb(error.__traceback__) if f"{os.sep}lumigraph{os.sep}" in x.filename]
    where = f" for `{frames[-1].strip('_<>')}`" if frames else ""
    on = "the device" if isinstance(error, torch.OutOfMemoryError) else "this machine"
    return (
        f"Memory is short: {amount} was asked for{where}, which {on} does not have; take smaller pictures "
        f"(--downscale, --size) or smaller numbers, or end other programs"
    )


def free_memory() -> int:
    """Bytes that a program may still have: the machine's, or what is left of a container's limit."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            known = dict(line.split(":") for line in file)
        free = 1024 * int(known["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return 1 << 50
    for limit, used in CONTAINER_LIMITS:
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
    for limit, _ in CONTAINER_LIMITS:
        with suppress(OSError, ValueError):  # no container, or no limit
            total = min(total, int(Path(limit).read_text()))
    return int(IMAGES_SHARE * total)
