"""A command in a copy of this process, watched: how it ended, what it said, how much memory it took, how long."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

LOOKS = 0.02  # seconds between looks at it
GRACE = 20.0  # seconds that a command may take to heed SIGTERM
PAGE = os.sysconf("SC_PAGE_SIZE")
FARTHEST = 16 << 30  # bytes of addresses beyond those that it begins with: what asks for more at once is refused
LARGEST = 1 << 31  # bytes of a file


@dataclass(frozen=True)
class Limits:
    """seconds: that it may take;  memory: bytes that it may hold;  patient: it may take longer, if it heeds SIGTERM"""

    seconds: float = 60.0
    memory: int = 4 << 30
    patient: bool = False


@dataclass(frozen=True)
class Ended:
    """code: exit code, or minus the signal that ended it;  why: we ended it, if so

    memory: bytes that it and its children took, at most, beyond those of this process

    left: whether processes that it started were still there a moment later
    """

    code: int
    said: str
    shown: str
    seconds: float
    memory: int
    why: Literal["", "hang", "memory"]
    left: bool


def watch(command: Callable[[], int], folder: Path, notes: Path, limits: Limits = Limits()) -> Ended:
    """How a function ended that ran in a copy of this process.

    folder: where it works;  notes: an existing folder for what it says, outside of `folder`
    """
    begin = time.perf_counter()
    before = resident(os.getpid())  # the copy begins with as much
    child = begun(command, folder, notes)
    why: Literal["", "hang", "memory"] = ""
    most, limit, asked = 0, limits.seconds, False
    while True:
        found, status, used = os.wait4(child, os.WNOHANG)
        if found:
            break
        most = max(most, sum(map(resident, family(child))) - before)
        if most > limits.memory:
            why = "memory"
        elif time.perf_counter() - begin > limit:
            if limits.patient and not asked:
                os.kill(child, signal.SIGTERM)
                asked, limit = True, limit + GRACE
            else:
                why = "hang"
        if why:
            os.killpg(child, signal.SIGKILL)
            _, status, used = os.wait4(child, 0)
            break
        time.sleep(min(LOOKS, 0.002 + (time.perf_counter() - begin) / 10))
    seconds = time.perf_counter() - begin
    left = still_there(child)
    said, shown = ((notes / name).read_text("utf-8", errors="replace") for name in ("stderr", "stdout"))
    return Ended(os.waitstatus_to_exitcode(status), said, shown, seconds, most, why, left)


def begun(command: Callable[[], int], folder: Path, notes: Path) -> int:
    """The number of a copy of this process that runs a function, in a group of its own."""
    sys.stdout.flush()
    sys.stderr.flush()
    if child := os.fork():
        with contextlib.suppress(OSError):  # it has done so itself
            os.setpgid(child, child)
        return child
    code = 1
    try:
        os.setpgid(0, 0)
        for number, name in ((1, "stdout"), (2, "stderr")):
            os.dup2(os.open(notes / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL if number == signal.SIGTERM else signal.default_int_handler)
        restrict()
        os.chdir(folder)
        code = command()
        sys.stdout.flush()
        sys.stderr.flush()
    except BaseException:
        import traceback

        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)


def restrict() -> None:
    """No core files, no file that fills the disk, and no more addresses than a machine has."""
    addresses = int(Path("/proc/self/statm").read_text().split()[0]) * PAGE if Path("/proc/self/statm").exists() else 0
    for what, most in (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, LARGEST),
        (resource.RLIMIT_AS, addresses + FARTHEST),
    ):
        hard = resource.getrlimit(what)[1]
        resource.setrlimit(what, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)


def resident(process: int) -> int:
    """Bytes of main memory that a process holds; 0 where the system does not tell, or once it has ended."""
    try:
        return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * PAGE
    except (OSError, IndexError):
        return 0


def family(process: int) -> list[int]:
    """A process and those that it started, and that these started."""
    try:
        children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    except OSError:
        children = []
    return [process, *(one for child in children for one in family(int(child)))]


def still_there(group: int, patience: float = 2.0) -> bool:
    """Whether processes of a group outlive its leader by more than a moment; they are ended then."""
    end = time.perf_counter() + patience
    while True:
        try:
            os.killpg(group, 0)
        except (ProcessLookupError, PermissionError):
            return False
        if time.perf_counter() > end:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(group, signal.SIGKILL)
            return True
        time.sleep(0.02)
