"""How much memory this process has needed."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path

import torch

STATUS = Path("/proc/self/status")


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
