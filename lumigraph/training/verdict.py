"""Verdict: what training has come to, measured: how often everything was seen, and whether it still got better."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..camera import Camera
from ..datasets.alignment import Moves, moves
from ..datasets.dataset import Dataset
from ..datasets.scene import Photograph, Scene
from ..method import Lesson, Method
from ..metrics.rows import of_final_size

STRETCH_COUNTS = 4, 30  # at least and at most, that the second half of training is divided into; fewer tell nothing
FALLING_SHARE = 0.05  # share of the loss, over the second half, from which on it still falls
FALL_DEVIATIONS = 2.0  # of its own error that a fall must exceed


def shares_seen(data: Dataset) -> Callable[[Lesson], float]:
    """A function that tells how much of what there is to learn from one lesson shows: 1 for all of it once, 0 where
    there is no end of it."""
    photographs, pixels = len(data.splits["train"]), data.pixels("train") if isinstance(data, Scene) else math.inf
    return lambda lesson: 1 / photographs if isinstance(lesson, Photograph) else len(lesson) / pixels


@dataclass(frozen=True)
class Trend:
    """Trend of the loss over the second half of training, or over the part of it with photographs of the final size.

    fall:  from its beginning to its end, as a share of the loss; negative where it rose
    error: one standard deviation of that
    share: of training that it spans
    """

    fall: float
    error: float
    share: float = 0.5

    @property
    def falling(self) -> bool:
        return self.fall > max(2 * self.share * FALLING_SHARE, FALL_DEVIATIONS * self.error)


def loss_trend(rows: Sequence[dict[str, Any]], by_photograph: bool) -> Trend | None:
    """Trend of the loss from the lines of metrics.jsonl; None where there are too few lines.

    A straight line through its logarithm, by least squares; the scatter around it tells the error. Some photographs are
    harder than others: where a step learns from one (by_photograph), points on the line are means over at least a whole
    pass, in which each photograph has its turn once, so that only what was learnt is left.
    """
    found = [row for row in rows if "mean_loss" in row]
    half = [row for row in of_final_size(found) if row["step"] > found[-1]["step"] / 2]
    least, most = STRETCH_COUNTS
    passes = int(half[-1]["passes"] - half[0]["passes"]) if half and by_photograph else most
    stretches = min(len(half), passes, most)
    if stretches < least:
        return None
    parts = np.array_split(np.array([(row["step"], row["mean_loss"]) for row in half], np.float64), stretches)
    step, loss = np.array([part.mean(0) for part in parts]).T
    if not (loss > 0).all():
        return None
    log, offset, length = np.log(loss), step - step.mean(), half[-1]["step"] - half[0]["step"]
    slope = (offset @ log) / (offset @ offset)
    scatter = log - log.mean() - slope * offset
    deviation = math.sqrt((scatter @ scatter) / (stretches - 2) / (offset @ offset))
    return Trend(1 - math.exp(slope * length), deviation * length, length / half[-1]["step"])


def cameras_moved(method: Method, cameras: Camera) -> Moves | None:
    """Displacement of the training cameras by a method, each against all of them; None where it learns no
    poses. cameras: those of training photographs as they were given"""
    refined = method.refined(cameras)
    return None if refined is cameras else moves(cameras, refined, method.frame)
