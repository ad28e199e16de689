"""Pace: how large a picture can be if it shall not take longer than so many seconds."""

from __future__ import annotations

import math

SMALLEST = 80  # pixels along the longer side
MEMORY = 0.5  # share of the known cost that one picture keeps


class Pace:
    """What a pixel has cost of late, all waiting included, and what size that makes."""

    def __init__(self) -> None:
        self.seconds_per_pixel: float | None = None

    def note(self, pixels: int, seconds: float) -> None:
        """A picture took so long."""
        cost = seconds / max(pixels, 1)
        known = self.seconds_per_pixel
        self.seconds_per_pixel = cost if known is None else MEMORY * known + (1 - MEMORY) * cost

    def size(self, full: tuple[int, int], seconds: float) -> tuple[int, int]:
        """(width, height) in the shape of `full` that should take so many seconds; small while nothing is known."""
        smallest = min(1.0, SMALLEST / max(full))
        if self.seconds_per_pixel is None:
            return scaled(full, smallest)
        affordable = seconds / max(self.seconds_per_pixel, 1e-12)
        return scaled(full, min(1.0, max(smallest, math.sqrt(affordable / (full[0] * full[1])))))


def scaled(size: tuple[int, int], share: float) -> tuple[int, int]:
    return max(1, round(size[0] * share)), max(1, round(size[1] * share))
