"""Ctrl-C and SIGTERM: work ends cleanly, and exit codes name the signal."""

from __future__ import annotations

import _thread
import contextlib
import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

HANDLED_SIGNALS = (signal.SIGINT, signal.SIGTERM)
REMINDER_SECONDS = 0.5  # between reminders
SIGACTION_BYTES = 1024  # no system's struct sigaction is as large


class Stopped(KeyboardInterrupt):
    """A signal to end the command. number: the signal's;  listener: raises it again until it is handled"""

    def __init__(self, number: int, listener: listening | None = None):
        super().__init__(number)
        self.number, self.listener = number, listener


def number_of(stopped: KeyboardInterrupt) -> int:
    """Signal number of an exception: KeyboardInterrupt is Ctrl-C's."""
    return stopped.number if isinstance(stopped, Stopped) else signal.SIGINT


def exit_code(number: int | None) -> int:
    """Exit code as in shells: 130 after Ctrl-C, 143 after SIGTERM, 0 without a signal."""
    return 0 if number is None else 128 + number


def go_on_unless(number: int | None) -> None:
    """Raise Stopped if there was a signal: for callers of `fit` that cannot use a partial result."""
    if number is not None:
        raise Stopped(number)


@contextlib.contextmanager
def until_interrupted() -> Iterator[None]:
    """Block that Ctrl-C ends without an error; SIGTERM still ends the command."""
    try:
        yield
    except KeyboardInterrupt as stopped:
        if number_of(stopped) != signal.SIGINT:
            raise
        if isinstance(stopped, Stopped) and stopped.listener:
            stopped.listener.heeded()


class listening:  # noqa: N801
    """Block in which both signals raise Stopped, even where the shell has Ctrl-C ignored.

    Libraries may swallow an asynchronous exception: NumPy does during its import, Python in a destructor. So none is
    raised during an import, and a swallowed one is raised again.
    """

    def __init__(self) -> None:
        self._handlers = Handlers(self._hear)
        self._heeded = threading.Event()
        self._reminding = False  # whether the next signal is but a reminder
        self._reminder: threading.Thread | None = None
        self._home: FrameType | None = None  # whose block it is

    def __enter__(self) -> None:
        self._home = sys._getframe(1)
        self._handlers.set()

    def __exit__(self, *fault: object) -> None:
        self.heeded()
        self._handlers.restore()
        self._home = None

    def heeded(self) -> None:
        """Mark the signal as handled."""
        self._heeded.set()
        if self._reminder is not None:
            self._reminder.join()
            self._reminder = None

    def _hear(self, number: int, frame: FrameType | None) -> None:
        reminded, self._reminding = self._reminding, False
        if reminded and self._heeded.is_set():
            return
        first = self._reminder is None
        if first:
            self._heeded.clear()
            self._reminder = threading.Thread(target=self._remind, args=(number,), name="reminder", daemon=True)
            self._reminder.start()
        is_on_its_way = isinstance(sys.exc_info()[1], Stopped)
        second = not (first or reminded)  # breaks off whatever is under way
        if second or not (is_on_its_way or self._is_loading(frame)):
            raise Stopped(number, self)

    def _remind(self, number: int) -> None:
        while not self._heeded.wait(REMINDER_SECONDS):
            self._reminding = True
            if sys.platform == "win32":
                _thread.interrupt_main(number)
            else:
                signal.pthread_kill(threading.main_thread().ident or 0, number)

    def _is_loading(self, frame: FrameType | None) -> bool:
        """True during an import inside the block."""
        while frame is not None and frame is not self._home:
            if frame.f_code.co_filename.startswith("<frozen importlib"):
                return True
            frame = frame.f_back
        return False


class Interrupt:
    """Block in which the first Ctrl-C or SIGTERM only records its number; the second acts as usual."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self._handlers = Handlers(self._note)

    def __enter__(self) -> Interrupt:
        self._handlers.set()
        return self

    def __exit__(self, *fault: object) -> None:
        self._handlers.restore()

    def _note(self, number: int, frame: object) -> None:
        self.signal = number
        self._handlers.restore()


class Handlers:
    """Handler of both signals, until `restore`. No effect outside the main thread."""

    def __init__(self, hear: Callable[[int, Any], object]):
        self.hear = hear
        self._before: dict[int, Any] = {}

    def set(self) -> None:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self.hear) for number in HANDLED_SIGNALS}

    def restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}


@contextlib.contextmanager
def untouched() -> Iterator[None]:
    """Block for importing a library that installs its own SIGTERM handler; restores the previous one.

    Python would not notice the replacement of its handler, so this uses the system call, which works in any thread.
    """
    if os.name == "nt":
        yield
        return
    system, before = ctypes.CDLL(None), ctypes.create_string_buffer(SIGACTION_BYTES)
    system.sigaction(signal.SIGTERM, None, before)
    try:
        yield
    finally:
        system.sigaction(signal.SIGTERM, before, None)
