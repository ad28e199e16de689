"""Memory: peak use of this process, free memory, and the budget of images."""

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
IMAGES_SHARE = 0.4  # of the memory that this process may take at most; the rest is for training
FREE_IMAGES_SHARE = 0.6  # of the memory that is free, which images may take
MAX_THREADS = 16  # more need more memory than they save time
BYTES_PER_PIXEL = 128  # while a picture is rendered: ray, colour, depth and opacity, in parts and in total
MEMORY_FAULTS = ("can't allocate memory", "bad_alloc", "Storage size calculation overflowed", "Cannot allocate memory")
UNITS = {unit: 1024**power for power, unit in enumerate("bKMGTPE")}
CONTROL_GROUPS, OWN_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
GROUP_FILES = {  # limit of a control group, its use, and the use that the system takes back: cached files
    2: ("memory.max", "memory.current", "inactive_file"),
    1: ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
}


def peak_memory(device: torch.device) -> int:
    """Peak memory of this process in bytes: on a GPU that of tensors, otherwise resident main memory; 0 if unknown."""
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
    """Free bytes on a device."""
    if device.type != "cuda":
        return free_memory()
    reserved = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return torch.cuda.mem_get_info(device)[0] + reserved


def ask_for(size: int, device: torch.device, what: str, remedy: Callable[[], str] | str) -> None:
    """Raise LumigraphError unless a device has this much free memory. what: its purpose; remedy: way to need less"""
    if size > (free := free_on(device)):
        less = remedy if isinstance(remedy, str) else remedy()
        raise LumigraphError(f"{what} would need {gigabytes(size)} of memory, and {gigabytes(free)} are free; {less}")


def ask_for_picture(width: int, height: int, device: torch.device) -> None:
    """Raise LumigraphError unless a device has memory for a rendering of this size."""
    what = f"A picture of {width} x {height} pixels"
    ask_for(BYTES_PER_PIXEL * width * height, device, what, "give a smaller --size")


def gigabytes(size: float) -> str:
    """Bytes as text: "0.3 GB", "1,234 GB"."""
    return f"{size / 1e9:,.1f} GB" if size < 1e11 else f"{size / 1e9:,.0f} GB"


def want_of_memory(error: BaseException) -> str | None:
    """Sentence for an out-of-memory error, with purpose and size. None for any other error."""
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
    """Free bytes of this process: the least of the machine, its control groups and its address space."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            known = dict(line.split(":") for line in file)
        free = 1024 * int(known["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        free = 1 << 50
    return max(0, min([free, *(limit - used for limit, used in limits())]))


def limits() -> list[tuple[int, int]]:
    """Memory limits of this process and use of each, in bytes: of its control groups (version 1 or 2) with their
    parents, and of its address space (`ulimit -v`)."""
    return group_limits() + address_limit()


def address_limit() -> list[tuple[int, int]]:
    """Limit of the address space and its use, mapped files included; empty without a limit."""
    with suppress(OSError, ValueError, ImportError, IndexError):
        resource = importlib.import_module("resource")
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        used = 1024 * int(re.findall(r"VmSize:\s*(\d+) kB", open_text(STATUS_FILE))[0])
        return [(limit, used)] if limit != resource.RLIM_INFINITY else []
    return []


def group_limits() -> list[tuple[int, int]]:
    """Limits and use of the control groups alone; cached files that are not in use count as free."""
    found = []
    with suppress(OSError, ValueError):
        for line in open_text(OWN_GROUPS).splitlines():
            number, controllers, path = line.split(":", 2)
            version = 2 if number == "0" else 1
            if version == 1 and "memory" not in controllers.split(","):
                continue
            top = CONTROL_GROUPS if version == 2 else CONTROL_GROUPS / "memory"
            own = top / path.strip("/")
            for folder in [own, *own.parents][: len(own.parts) - len(top.parts) + 1]:
                limit, use, cached = GROUP_FILES[version]
                with suppress(OSError, ValueError):  # the top has no limit
                    most, now = (int(open_text(folder / name)) for name in (limit, use))
                    rows = (row.split() for row in open_text(folder / "memory.stat").splitlines())
                    found.append((most, now - sum(int(value) for name, value in rows if name == cached)))
    return found


def open_text(path: Path) -> str:
    with open(path, encoding="utf-8") as file:
        return file.read()


def memory_for_images() -> int:
    """Memory budget of images in bytes: a share of this process's total memory, and of its free memory."""
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        total = 8 << 30
    total = min([total, *(limit for limit, _ in limits())])
    return int(min(IMAGES_SHARE * total, FREE_IMAGES_SHARE * free_memory()))


def threads_for(each: int, most: int = MAX_THREADS) -> int:
    """Number of threads for work of so many bytes each: at least one, at most the processor's."""
    return max(1, min(os.cpu_count() or 1, most, room_for(each, torch.device("cpu"))))
