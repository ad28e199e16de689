"""Turns: mutual exclusion of renderings and training on one method."""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator

RENDER_SHARE = 0.5  # of the time that renderings may take from training while a camera moves
REFRESH_SECONDS = 0.1, 1.0  # least and longest time between two claims of a client at rest
POLL_SECONDS = 0.1  # seconds between checks whether to stop waiting


class NotWantedError(Exception):
    """A waiting or running rendering is obsolete."""


class Turns:
    """Fair queue of renderings. Training owns the method by default and yields between steps, so that renderings get at
    most their share of the time.

    training:   whether training is in progress; `give_way` must then be called between steps, until `end_training`
    idle_share: share of the time for clients at rest: `Method.idle_render_share`
    rendered:   seconds of all turns so far, without waiting for them
    """

    def __init__(self, training: bool = False, idle_share: float = 1.0):
        self.training, self.paused, self._idle_share = training, False, idle_share
        self._condition = threading.Condition()
        self._waiting: deque[object] = deque()
        self._open = False  # training gives way at the moment
        self._busy = False  # a rendering has its turn
        self._served, self.rendered = 0, 0.0
        self._own_until = 0.0  # until then training need not give way
        self._idle_until = 0.0  # until then no client at rest may request a newer picture

    @contextlib.contextmanager
    def turn(self, wanted: Callable[[], bool] = lambda: True) -> Iterator[None]:
        """Wait for exclusive use of the method. Raises NotWantedError if `wanted()` becomes false while waiting."""
        ticket = object()
        with self._condition:
            self._waiting.append(ticket)
            try:
                while self._busy or self._waiting[0] is not ticket or (self.training and not self._open):
                    self._condition.wait(POLL_SECONDS)
                    if not wanted():
                        raise NotWantedError
                self._busy = True
            finally:
                self._waiting.remove(ticket)
                self._condition.notify_all()
        begin = time.perf_counter()
        try:
            yield
        finally:
            end = time.perf_counter()
            with self._condition:
                self._busy, self._served = False, self._served + 1
                self.rendered += end - begin
                self._open = self._open and self.paused  # the next one has to wait until training gives way again
                self._own_until = end + (end - begin) * (1 / RENDER_SHARE - 1)
                self._condition.notify_all()

    @property
    def asked(self) -> bool:
        """True if training must yield: a rendering waits and training had its share, or it is paused."""
        return self.paused or bool(self._waiting) and time.perf_counter() >= self._own_until

    def give_way(self, stopping: Callable[[], object] = lambda: False) -> None:
        """Yield to the rendering that has waited longest; while paused, to all. Called between two steps.

        stopping: true if training must not wait any longer
        """
        with self._condition:
            before, self._open = self._served, True
            self._condition.notify_all()
            while (self.paused or (self._served == before and self._waiting) or self._busy) and not (
                stopping() and not self._busy
            ):
                self._condition.wait(POLL_SECONDS)
            self._open = False

    def end_training(self) -> None:
        """End training; the method is free for renderings."""
        with self._condition:
            self.training = self.paused = False
            self._condition.notify_all()

    def claim_refresh(self) -> bool:
        """True if a client at rest may refresh after training steps; other clients then wait until `refreshed`."""
        with self._condition:
            if self.training and not self.paused and time.perf_counter() < self._idle_until:
                return False
            self._idle_until = float("inf") if self.training else 0.0
            return True

    def refreshed(self, seconds: float) -> None:
        """Record the end of a refresh, and its rendering time."""
        with self._condition:
            self._idle_until = time.perf_counter() + seconds / self._idle_share

    def until_refresh(self) -> float:
        """Seconds until a client at rest may refresh again."""
        least, longest = REFRESH_SECONDS
        return min(max(self._idle_until - time.perf_counter(), least), longest)
