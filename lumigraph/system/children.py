"""Child processes: Python that imports only installed packages, in a folder of ours, ended with its parent.

Python puts its working directory first on the import path, and Numba reads a configuration there. So a child never
works in a folder that another user may have made. Its task is a Request, in which text stays data.
"""

import contextlib
import ctypes
import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).resolve().parents[1]
PR_SET_PDEATHSIG = 1  # Linux's number
PYTHON = sys.executable, "-P"  # imports do not begin in the working directory
REQUESTED = "-m", "lumigraph.commands.request"  # the program that runs the Request on its standard input


@dataclass(frozen=True)
class Request:
    """A command by its name on the command line, and values of the fields of its dataclass, as JSON has them."""

    command: str
    options: dict[str, Any] = field(default_factory=dict)

    def start(self, program: Sequence[str] = REQUESTED, **pipes: Any) -> subprocess.Popen[Any]:
        """Start a child process that runs the request. program: words of Python before it; pipes: of Popen"""
        child = start_python(program, stdin=subprocess.PIPE, **pipes)
        assert child.stdin is not None
        with contextlib.suppress(BrokenPipeError), child.stdin:  # a child that has ended already
            child.stdin.write(json.dumps(asdict(self)).encode())
        return child


def start_python(
    words: Sequence[str], ends_by: int = signal.SIGTERM, folder: Path = PACKAGE, **options: Any
) -> subprocess.Popen[Any]:
    """subprocess.Popen of Python with these words, which imports nothing from the working directory.

    folder:  the working directory, for words with relative paths
    ends_by: signal to the child when this process ends, even if killed. Only Linux guarantees it; elsewhere a child
             should watch its standard input, which closes at the same time.
    """
    tied_to_us = tied(ends_by) if sys.platform == "linux" else None
    return subprocess.Popen([*PYTHON, *words], cwd=folder, preexec_fn=tied_to_us, **options)


def tied(number: int) -> Any:
    """Set-up of the child between fork and exec, where it must not load modules."""
    prctl, parent = ctypes.CDLL(None).prctl, os.getpid()

    def tie() -> None:
        prctl(PR_SET_PDEATHSIG, number)
        if os.getppid() != parent:  # it died just before
            os._exit(1)

    return tie
