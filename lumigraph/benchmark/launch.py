"""Commands in processes of their own, so that their memory is theirs alone and a fault of one is not another's."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from .. import files
from ..errors import LumigraphError
from ..system.processes import start
from ..system.signals import Interrupt

Launch = Callable[[Sequence[str], Path], int]
STOP_CODES = (130, 143)  # after Ctrl-C and SIGTERM
PROMPT = b"$ lumigraph "  # each command in a log begins so
POLL_SECONDS = 0.2  # seconds between looks at whether to stop


def launch(arguments: Sequence[str], log: Path) -> int:
    """Run `lumigraph ARGUMENTS`, with all that it says added to a log. Returns its exit code, as shells count.

    Ctrl-C and SIGTERM are passed on, and the command may end as it does by itself: with its state saved. It does so too
    when this process is killed. It stands apart from the terminal, which would send it Ctrl-C a second time.
    """
    with files.explained(log):
        log.parent.mkdir(parents=True, exist_ok=True)
        out = open(log, "ab")
    with out, Interrupt() as interrupt:
        out.write(PROMPT + f"{' '.join(arguments)}\n".encode())
        out.flush()
        command = [sys.executable, "-m", "lumigraph", *arguments]
        process = start(command, stdin=subprocess.DEVNULL, stdout=out, stderr=out, start_new_session=True)
        passed_on = False
        try:
            while (code := ended(process)) is None:
                if interrupt.signal and not passed_on and os.name != "nt":  # Windows tells both by itself
                    process.send_signal(interrupt.signal)
                    passed_on = True
        finally:
            if process.poll() is None:  # a second Ctrl-C
                process.kill()
                process.wait()
    if interrupt.signal:
        return 128 + interrupt.signal  # even if the command was done just then: whoever asked wants to stop
    return code if code >= 0 else 128 - code


def claim_log(log: Path) -> None:
    """Raise LumigraphError unless lines may be added to a log: it is a benchmark's, or not there."""
    with files.explained(log):
        if os.path.lexists(log) and (log.is_symlink() or log.read_bytes()[: len(PROMPT)] != PROMPT):
            raise LumigraphError(f"{log} is no log of a benchmark; move it away, or choose another --output")


def ended(process: subprocess.Popen[bytes]) -> int | None:
    """A process's exit code; None if the process has not ended after a moment."""
    try:
        return process.wait(POLL_SECONDS)
    except subprocess.TimeoutExpired:
        return None


def reason(log: Path, code: int) -> str:
    """Why a command failed: the sentence it said last."""
    if code > 128:
        return f"ended by signal {code - 128}" + (", perhaps because memory was short" if code == 137 else "")
    lines = [line for line in log.read_text("utf-8", errors="replace").splitlines() if line.strip()]
    return lines[-1].removeprefix("lumigraph: ") if lines else f"exit code {code}"
