"""Ctrl-C and SIGTERM: what is at hand ends, nothing half-done is called done, and the exit code says which it was."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

NUMBERS = (signal.SIGINT, signal.SIGTERM)
ROOM = 1024  # bytes; no system's struct sigaction is as large


class Stopped(KeyboardInterrupt):
    """Somebody asked the command to end. number: the signal's"""

    def __init__(self, number: int):
        super().__init__(number)
        self.number = number


def number_of(stopped: KeyboardInterrupt) -> int:
    """The signal behind an exception: Python's own is Ctrl-C's."""
    return stopped.number if isinstance(stopped, Stopped) else signal.SIGINT


def go_on_unless(number: int | None) -> None:
    """Raise Stopped if there was a signal: for who calls `fit` and has no use for what is half learnt."""
    if number is not None:
        raise Stopped(number)


@contextlib.contextmanager
def listening() -> Iterator[None]:
    """Inside this block both signals raise Stopped, even where the shell has Ctrl-C ignored: who sends it means it."""

    def stop(number: int, frame: object) -> None:
        raise Stopped(number)

    handlers = Handlers(stop)
    handlers.set()
    try:
        yield
    finally:
        handlers.restore()


@contextlib.contextmanager
def until_interrupted() -> Iterator[None]:
    """A block that ends by Ctrl-C, which is well; SIGTERM still ends the command."""
    try:
        yield
    except KeyboardInterrupt as stopped:
        if number_of(stopped) != signal.SIGINT:
            raise


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
    """One function that hears both signals, until `restore`. In other threads than the main one nobody can."""

    def __init__(self, hear: Callable[[int, Any], object]):
        self.hear = hear
        self._before: dict[int, Any] = {}

    def set(self) -> None:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self.hear) for number in NUMBERS}

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
    system, before = ctypes.CDLL(None), ctypes.create_string_buffer(ROOM)
    system.sigaction(signal.SIGTERM, None, before)
    try:
        yield
    finally:
        system.sigaction(signal.SIGTERM, before, None)
