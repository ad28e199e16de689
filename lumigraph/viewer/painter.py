"""Painter: rendering thread of one client, coarse while its camera moves, finer at rest.
Pace: picture size for a given rendering time. MovingPace: the same while the camera moves."""

import math
import threading
import time
from collections.abc import Callable

import numpy as np

from .turns import NotWantedError, Turns

MIN_RESOLUTION = 80  # pixels along the longer side
SMOOTHING = 0.7  # share of its weight that a picture keeps when the next has come


class Pace:
    """Rendering time as a line, a + b times the number of pixels, fitted to recent pictures."""

    def __init__(self) -> None:
        self._sums = np.zeros(5)  # of 1, n, n^2, t, n t over pictures of n pixels and t seconds, older ones fading
        self._noted = False

    def note(self, pixels: int, seconds: float) -> None:
        """Record a picture's time. The first is ignored, since it may include compilation."""
        if self._noted:
            n, t = float(pixels), seconds
            self._sums = SMOOTHING * self._sums + np.array([1, n, n * n, t, n * t])
        self._noted = True

    @property
    def costs(self) -> tuple[float, float] | None:
        """(a, b), neither below zero; None before the first measurement."""
        one, n, nn, t, nt = self._sums
        if one == 0:
            return None
        spread = one * nn - n * n
        b = (one * nt - n * t) / spread if spread > 1e-3 * one * nn else 0.0
        a = (t - b * n) / one
        return (a, b) if a >= 0 and b > 0 else (0.0, t / n)

    def pixels(self, seconds: float) -> float:
        """Number of pixels that can be rendered in a time. Where most of that time is a picture's fixed cost, 1.5 times
        as long is
        allowed: a smaller picture would hardly be faster."""
        if self.costs is None:
            return 0.0
        a, b = self.costs
        return max(seconds - a, 0.5 * a) / max(b, 1e-12)

    def size(self, full: tuple[int, int], seconds: float) -> tuple[int, int]:
        """(width, height) with the aspect of `full` that can be rendered in a time; small at first. `full` itself if
        that takes at most FULL_FACTOR times as long, because a smaller picture before it would only delay it."""
        if self.pixels(FULL_FACTOR * seconds) >= full[0] * full[1]:
            return full
        share = math.sqrt(self.pixels(seconds) / (full[0] * full[1]))
        share = min(1.0, max(share, MIN_RESOLUTION / max(full)))
        return max(1, round(full[0] * share)), max(1, round(full[1] * share))


MOVING_SECONDS, RESTING_SECONDS = 0.1, 0.5  # for a picture while the camera moves, and for the first one at rest
REST_SECONDS = 0.2  # seconds after the last request from which a client counts as resting
FULL_FACTOR = 2.0  # on the time of a picture at rest, which one of full size may take instead
FRAME_SECONDS = 1 / 30  # for a picture of full size while the camera moves
MIN_FRAME_SECONDS = 1 / 60  # seconds between pictures
NO_DEADLINE = float("inf")
DIVISORS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)  # of width and height while the camera moves
KEPT_PICTURES = 60  # moving pictures after which an unused size's time is forgotten, and the size tried again
FIXED_COST_FACTOR = 1.5  # on the least time of any size, which a picture may take if none is quick enough


class MovingPace:
    """Size of pictures while the camera moves, by recent times of a few sizes: full size if that takes FRAME_SECONDS,
    else half or less within MOVING_SECONDS. Few sizes, so that the resolution seldom changes."""

    def __init__(self) -> None:
        self._seconds: dict[int, float] = {}  # by divisor
        self._used: dict[int, int] = {}  # number of the last picture
        self._count = 0

    def note(self, divisor: int, seconds: float) -> None:
        """Record a picture's time. The first is ignored, since it may include compilation."""
        self._count += 1
        if self._count > 1:
            before = self._seconds.get(divisor, seconds)
            self._seconds[divisor] = SMOOTHING * before + (1 - SMOOTHING) * seconds
            self._used[divisor] = self._count
        for old in [k for k in self._seconds if self._count - self._used[k] > KEPT_PICTURES]:
            del self._seconds[old]

    def divisor(self, full: tuple[int, int]) -> int:
        """Divisor of the width and height of `full`; a large one at first."""
        possible = [k for k in DIVISORS if k == 1 or max(full) >= k * MIN_RESOLUTION]
        if not self._seconds:
            return possible[-1]
        expected = {k: self._expected(k) for k in possible}
        most = max(MOVING_SECONDS, FIXED_COST_FACTOR * min(expected.values()))
        return next(k for k in possible if expected[k] <= (FRAME_SECONDS if k == 1 else most) or k == possible[-1])

    def _expected(self, divisor: int) -> float:
        """Expected seconds of a picture: as measured, interpolated by number of pixels, or extrapolated from a single
        size in proportion to its side."""
        if divisor in self._seconds:
            return self._seconds[divisor]
        sizes, seconds = 1 / np.array([*self._seconds]) ** 2.0, np.array([*self._seconds.values()])
        if len(sizes) == 1:
            return float(seconds[0] * math.sqrt(1 / sizes[0]) / divisor)
        slope = max(0.0, float(np.cov(sizes, seconds)[0, 1] / sizes.var(ddof=1)))
        return max(0.0, float(seconds.mean()) + slope * (1 / divisor**2 - float(sizes.mean())))


Draw = Callable[[float, Callable[[], bool]], bool]


class Painter:
    """Rendering thread. Only the last request counts; a picture at rest is abandoned when another request comes.

    draw:  draw(seconds, wanted) shows the best picture that takes about so many seconds and returns True if no better
           one is possible; it raises NotWantedError as soon as wanted() is false
    fault: called with each exception
    step:  returns the training step of the method; pictures of an earlier step are stale
    """

    def __init__(
        self, draw: Draw, turns: Turns, fault: Callable[[Exception], None], step: Callable[[], int] = lambda: 0
    ):
        self._draw, self._turns, self._fault, self._step = draw, turns, fault, step
        self._requested, self._when, self._stopped = 0, 0.0, False
        self._wake = threading.Event()
        self.settled = threading.Event()  # the best picture of the last request is shown
        self._thread = threading.Thread(target=self._work, name="painter", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def request(self) -> None:
        """Request a new picture; the one in progress is outdated."""
        self.settled.clear()
        self._requested, self._when = self._requested + 1, time.perf_counter()
        self._wake.set()

    def stop(self) -> None:
        self._stopped = True
        self._wake.set()

    def _work(self) -> None:
        drawn, best, step = 0, True, self._step()
        while not self._stopped:
            requested, now = self._requested, time.perf_counter()
            if requested != drawn:
                step, drawn = self._step(), requested
                best = self._try(MOVING_SECONDS, lambda: not self._stopped)
                self._sleep(MIN_FRAME_SECONDS - (time.perf_counter() - now))
            elif now < self._when + REST_SECONDS:
                self._sleep(self._when + REST_SECONDS - now)
            elif not best:
                best = self._refine(requested)
            elif self._step() != step and self._turns.claim_refresh():
                step, before = self._step(), self._turns.rendered
                self._try(self._longest, self._while_current(requested))
                self._turns.refreshed(self._turns.rendered - before)
            else:
                if self._requested == requested:
                    self.settled.set()
                self._sleep(self._turns.until_refresh())

    def _refine(self, requested: int) -> bool:
        """Render progressively better pictures; returns whether the best was reached before another request came."""
        for seconds in dict.fromkeys([RESTING_SECONDS, self._longest]):
            if self._try(seconds, self._while_current(requested)):
                return True
            if self._requested != requested:
                return False
        return True

    def _while_current(self, requested: int) -> Callable[[], bool]:
        """A function that returns True until another request comes."""
        return lambda: not self._stopped and self._requested == requested

    @property
    def _longest(self) -> float:
        """Largest rendering time of a picture at rest, in seconds: limited while training, when it is soon outdated."""
        return RESTING_SECONDS if self._turns.training and not self._turns.paused else NO_DEADLINE

    def _try(self, seconds: float, wanted: Callable[[], bool]) -> bool:
        try:
            return self._draw(seconds, wanted)
        except NotWantedError:
            return False
        except Exception as error:  # pictures of other clients go on
            if not self._stopped:
                self._fault(error)
            return True

    def _sleep(self, seconds: float) -> None:
        if seconds > 0 and not self._stopped:
            self._wake.wait(seconds)
        self._wake.clear()
