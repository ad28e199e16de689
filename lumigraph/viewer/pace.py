"""Pace: the size of a picture that can be rendered in a given time, from what earlier pictures cost."""

from __future__ import annotations

import math

import numpy as np

MIN_RESOLUTION = 80  # pixels along the longer side
SMOOTHING = 0.7  # share of its weight that a picture keeps when the next has come


class Pace:
    """Rendering time as a line, a + b times the number of pixels, fitted to recent pictures."""

    def __init__(self) -> None:
        self._sums = np.zeros(5)  # of 1, n, n^2, t, n t over pictures of n pixels and t seconds, older ones fading
        self._noted = False

    def note(self, pixels: int, seconds: float) -> None:
        """Take note of a picture's time. The first is ignored: something may have been compiled for it."""
        if self._noted:
            n, t = float(pixels), seconds
            self._sums = SMOOTHING * self._sums + np.array([1, n, n * n, t, n * t])
        self._noted = True

    @property
    def costs(self) -> tuple[float, float] | None:
        """(a, b), neither below zero; None while nothing is known."""
        one, n, nn, t, nt = self._sums
        if one == 0:
            return None
        spread = one * nn - n * n
        b = (one * nt - n * t) / spread if spread > 1e-3 * one * nn else 0.0
        a = (t - b * n) / one
        return (a, b) if a >= 0 and b > 0 else (0.0, t / n)

    def pixels(self, seconds: float) -> float:
        """Number of pixels that can be rendered in a time. Where most of that time is a picture's fixed
        cost, half as much again is allowed: a smaller picture would hardly be quicker."""
        if self.costs is None:
            return 0.0
        a, b = self.costs
        return max(seconds - a, 0.5 * a) / max(b, 1e-12)

    def size(self, full: tuple[int, int], seconds: float) -> tuple[int, int]:
        """(width, height) with the aspect of `full` that can be rendered in a time; small while nothing is known."""
        share = math.sqrt(self.pixels(seconds) / (full[0] * full[1]))
        share = min(1.0, max(share, MIN_RESOLUTION / max(full)))
        return max(1, round(full[0] * share)), max(1, round(full[1] * share))
