"""How much more fits into memory."""

from __future__ import annotations

import torch

SPARED = 0.3  # of what is free now, for everybody else


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
    for limit, used in (
        ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
        ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
    ):
        try:
            with open(limit, encoding="ascii") as most, open(used, encoding="ascii") as now:
                free = min(free, int(most.read()) - int(now.read()))
        except (OSError, ValueError):
            continue
    return max(free, 0)
