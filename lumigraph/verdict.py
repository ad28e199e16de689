"""Verdict: what training has come to, measured, and what would help most now."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .dataset import Dataset
from .method import Lesson
from .scene import Photograph, Scene

FEW = 8  # lines of metrics.jsonl in a third of training, below which nothing is said of its trend
RISING = 0.3  # dB over the last third of training from which on it is still rising
DEVIATIONS = 2.0  # of its own error that a rise must exceed


def shares_seen(data: Dataset) -> Callable[[Lesson], float]:
    """A function that tells how much of what there is to learn from one lesson shows: 1 for all of it once, 0 where
    there is no end of it."""
    photographs, pixels = len(data.splits["train"]), data.pixels("train") if isinstance(data, Scene) else math.inf
    return lambda lesson: 1 / photographs if isinstance(lesson, Photograph) else len(lesson) / pixels


@dataclass(frozen=True)
class Trend:
    """How a figure moved over the last third of training.

    last:  its mean there
    rise:  from the third's beginning to its end, along the straight line that fits it best
    error: one standard deviation of that rise
    """

    last: float
    rise: float
    error: float

    @property
    def rising(self) -> bool:
        return self.rise > max(RISING, DEVIATIONS * self.error)


def psnr_trend(rows: Sequence[dict[str, Any]]) -> Trend | None:
    """How the PSNR of training photographs moved, in dB, by the lines of metrics.jsonl; None where there are too few.

    Over steps, by least squares. Neighbouring lines show other photographs, so their scatter around the line is taken
    for noise, from which the error of its slope follows.
    """
    found = [(row["step"], row["psnr"]) for row in rows if "psnr" in row]
    last = found and [(step, psnr) for step, psnr in found if step > 2 / 3 * found[-1][0]]
    if not last or len(last) < FEW:
        return None
    step, psnr = np.array(last, np.float64).T
    length = step[-1] - step[0]
    offset = step - step.mean()
    slope = (offset @ psnr) / (offset @ offset)
    scatter = psnr - psnr.mean() - slope * offset
    variance = (scatter @ scatter) / (len(step) - 2) / (offset @ offset)
    return Trend(float(psnr.mean()), float(slope * length), float(math.sqrt(variance) * length))
