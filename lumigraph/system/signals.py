"""Ctrl-C and SIGTERM: work ends, nothing half-done counts as done, exit codes name the signal."""

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
    """A signal to end the command. number: the signal's;  listener: repeats it until it is heeded"""

    def __init__(self, number: int, listener: listening | None = None):
        super().__init__(number)
        self.number, self.listener = number, listener


def number_of(stopped: KeyboardInterrupt) -> int:
    """The signal behind an exception: Python's own is Ctrl-C's."""
    return stopped.number if isinstance(stopped, Stopped) else signal.SIGINT


def exit_code(number: int | None) -> int:
    """Exit code as in shells: 130 after Ctrl-C, 143 after SIGTERM, 0 without a signal."""
    return 0 if number is None else 128 + number


def go_on_unless(number: int | None) -> None:
    """Raise Stopped if there was a signal: for who calls `fit` and has no use for what is half learnt."""
    if number is not None:
        raise Stopped(number)


@contextlib.contextmanager
def until_interrupted() -> Iterator[None]:
    """A block that ends by Ctrl-C, which is well; SIGTERM still ends the command."""
    try:
        yield
    except KeyboardInterrupt as stopped:
        if number_of(stopped) != signal.SIGINT:
            raise
        if isinstance(stopped, Stopped) and stopped.listener:
            stopped.listener.heeded()


class listening:  # noqa: N801
    """Inside this block both signals raise Stopped, even where the shell has Ctrl-C ignored: who sends it means it.

    Libraries may lose an exception that comes out of nowhere: NumPy does when it is loaded, Python in a destructor. So
    none is raised while something is loaded, and one that was lost is raised again.
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
        """The signal has ended what it was to end."""
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
        """True while a module is being loaded inside the block."""
        while frame is not None and frame is not self._home:
            if frame.f_code.co_filename.startswith("<frozen importlib"):
                return True
            frame = frame.f_back
        return False


class Interrupt:
    """Inside this block the first Ctrl-C or SIGTERM only leaves its number; the second acts as usual."""

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
    """Handler of both signals, until `restore`. Without effect in other threads than the main one."""

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
    """Inside this block a library may be loaded that takes SIGTERM for itself; afterwards it acts as before.

    Python would not notice that its own handler has gone, so this asks the system, which answers in any thread.
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
