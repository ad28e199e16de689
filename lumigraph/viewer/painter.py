"""Painter: draws for one client what it asked for last - coarse while it moves, finer once it rests."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from .turns import NotWantedError, Turns

MOVING, RESTING = 0.1, 0.5  # seconds that a picture may take while the camera moves, and the first one at rest
STILL = 0.2  # seconds after the last request from which a client counts as resting
FASTEST = 1 / 30  # seconds between pictures
ENDLESS = float("inf")

Draw = Callable[[float, Callable[[], bool]], bool]


class Painter:
    """One thread. What is asked last counts; a picture at rest is abandoned when something else is asked.

    draw:  draw(seconds, wanted) shows the best picture that should take so many seconds and says whether that was the
           best there is; it raises NotWantedError as soon as wanted() is false
    fault: told of anything that goes wrong
    stage: says how far the method has been trained; a new one makes pictures stale
    """

    def __init__(
        self, draw: Draw, turns: Turns, fault: Callable[[Exception], None], stage: Callable[[], int] = lambda: 0
    ):
        self._draw, self._turns, self._fault, self._stage = draw, turns, fault, stage
        self._asked, self._when, self._stopped = 0, 0.0, False
        self._wake = threading.Event()
        self.settled = threading.Event()  # the best picture of what was asked last is shown
        self._thread = threading.Thread(target=self._work, name="painter", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def ask(self) -> None:
        """Something is to be seen that was not; whatever is under way is out of date."""
        self.settled.clear()
        self._asked, self._when = self._asked + 1, time.perf_counter()
        self._wake.set()

    def stop(self) -> None:
        self._stopped = True
        self._wake.set()

    def _work(self) -> None:
        drawn, best, stage = 0, True, self._stage()
        while not self._stopped:
            asked, now = self._asked, time.perf_counter()
            if asked != drawn:
                stage, drawn = self._stage(), asked
                best = self._try(MOVING, lambda: not self._stopped)
                self._sleep(FASTEST - (time.perf_counter() - now))
            elif now < self._when + STILL:
                self._sleep(self._when + STILL - now)
            elif not best:
                best = self._refine(asked)
            elif self._stage() != stage and self._turns.claim_refresh():
                stage = self._stage()
                self._try(self._longest, self._while_asked(asked))
                self._turns.refreshed(time.perf_counter() - now)
            else:
                if self._asked == asked:
                    self.settled.set()
                self._sleep(1.0)

    def _refine(self, asked: int) -> bool:
        """Better pictures, one after the other, unless something else is asked meanwhile."""
        for seconds in dict.fromkeys([RESTING, self._longest]):
            if self._try(seconds, self._while_asked(asked)):
                return True
            if self._asked != asked:
                return False
        return True

    def _while_asked(self, asked: int) -> Callable[[], bool]:
        """Whether nothing else has been asked since."""
        return lambda: not self._stopped and self._asked == asked

    @property
    def _longest(self) -> float:
        """What a picture at rest may cost. While training it soon is out of date, and others want the machine."""
        return RESTING if self._turns.training and not self._turns.paused else ENDLESS

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
