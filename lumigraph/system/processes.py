"""Processes that do not outlive the one that started them."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

PR_SET_PDEATHSIG = 1  # Linux's number


def start(command: Sequence[str], ends_by: int = signal.SIGTERM, **options: Any) -> subprocess.Popen[Any]:
    """subprocess.Popen of a command that is sent a signal when this process ends, even where that was killed.

    Linux alone can promise that; elsewhere a child should watch its standard input, which ends at the same moment.
    """
    return subprocess.Popen(command, preexec_fn=tied(ends_by) if sys.platform == "linux" else None, **options)


def tied(number: int) -> Any:
    """Set-up of the child between fork and exec, where it must not load modules."""
    prctl, parent = ctypes.CDLL(None).prctl, os.getpid()

    def tie() -> None:
        prctl(PR_SET_PDEATHSIG, number)
        if os.getppid() != parent:  # it died just before
            os._exit(1)

    return tie
