"""Painter: a thread that draws what one client asked for last, coarse while its camera moves, finer once it rests."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from .turns import NotWantedError, Turns

MOVING_SECONDS, RESTING_SECONDS = (
    0.1,
    0.5,
)  # seconds that a picture may take while the camera moves, and the first one at rest
REST_SECONDS = 0.2  # seconds after the last request from which a client counts as resting
MIN_FRAME_SECONDS = 1 / 30  # seconds between pictures
NO_DEADLINE = float("inf")

Draw = Callable[[float, Callable[[], bool]], bool]


class Painter:
    """A thread that draws. The last request counts; a picture at rest is abandoned when another request comes.

    draw:  draw(seconds, wanted) shows the best picture that should take so many seconds and says whether that was the
           best there is; it raises NotWantedError as soon as wanted() is false
    fault: called with whatever goes wrong
    step:  gives the step to which the method has been trained; pictures of an earlier step are stale
    """

    def __init__(
        self, draw: Draw, turns: Turns, fault: Callable[[Exception], None], step: Callable[[], int] = lambda: 0
    ):
        self._draw, self._turns, self._fault, self._step = draw, turns, fault, step
        self._asked, self._when, self._stopped = 0, 0.0, False
        self._wake = threading.Event()
        self.settled = threading.Event()  # the best picture of what was asked last is shown
        self._thread = threading.Thread(target=self._work, name="painter", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def ask(self) -> None:
        """Request a new picture; what is being drawn is out of date."""
        self.settled.clear()
        self._asked, self._when = self._asked + 1, time.perf_counter()
        self._wake.set()

    def stop(self) -> None:
        self._stopped = True
        self._wake.set()

    def _work(self) -> None:
        drawn, best, step = 0, True, self._step()
        while not self._stopped:
            asked, now = self._asked, time.perf_counter()
            if asked != drawn:
                step, drawn = self._step(), asked
                best = self._try(MOVING_SECONDS, lambda: not self._stopped)
                self._sleep(MIN_FRAME_SECONDS - (time.perf_counter() - now))
            elif now < self._when + REST_SECONDS:
                self._sleep(self._when + REST_SECONDS - now)
            elif not best:
                best = self._refine(asked)
            elif self._step() != step and self._turns.claim_refresh():
                step = self._step()
                self._try(self._longest, self._while_asked(asked))
                self._turns.refreshed(time.perf_counter() - now)
            else:
                if self._asked == asked:
                    self.settled.set()
                self._sleep(1.0)

    def _refine(self, asked: int) -> bool:
        """Draw better pictures one after the other; whether the best was reached before another request came."""
        for seconds in dict.fromkeys([RESTING_SECONDS, self._longest]):
            if self._try(seconds, self._while_asked(asked)):
                return True
            if self._asked != asked:
                return False
        return True

    def _while_asked(self, asked: int) -> Callable[[], bool]:
        """A function that says whether no other request has come since."""
        return lambda: not self._stopped and self._asked == asked

    @property
    def _longest(self) -> float:
        """Seconds that a picture at rest may take: limited while training, when it is soon out of date."""
        return RESTING_SECONDS if self._turns.training and not self._turns.paused else NO_DEADLINE

    def _try(self, seconds: float, wanted: Callable[[], bool]) -> bool:
        try:
            return self._draw(seconds, wanted)
        except NotWantedError:
            return False
        except Exception as error:  # whatever it is, the others' pictures go on
            if not self._stopped:
                self._fault(error)
            return True

    def _sleep(self, seconds: float) -> None:
        if seconds > 0 and not self._stopped:
            self._wake.wait(seconds)
        self._wake.clear()
