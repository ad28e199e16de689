"""Verdict on a finished training: passes over the data, and whether the loss was still falling."""

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
    """Function for the share of the training data in one lesson: 1 for all of it, 0 for unlimited data."""
    photographs, pixels = len(data.splits["train"]), data.pixels("train") if isinstance(data, Scene) else math.inf
    return lambda lesson: 1 / photographs if isinstance(lesson, Photograph) else len(lesson) / pixels


@dataclass(frozen=True)
class Trend:
    """Trend of the loss over the second half of training, or over its part with photographs of full size.

    fall:  relative decrease of the loss from its beginning to its end; negative for an increase
    error: standard deviation of `fall`
    share: share of training that it spans
    """

    fall: float
    error: float
    share: float = 0.5

    @property
    def falling(self) -> bool:
        return self.fall > max(2 * self.share * FALLING_SHARE, FALL_DEVIATIONS * self.error)


def loss_trend(rows: Sequence[dict[str, Any]], by_photograph: bool) -> Trend | None:
    """Trend of the loss from the lines of metrics.jsonl; None for too few lines.

    Least-squares line through the logarithm of the loss; its scatter gives the error. Some photographs are harder than
    others: where a step learns from one (by_photograph), points on the line are means over at least a whole pass, in
    which each photograph occurs once, so that only progress is left.
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
    """Displacement of the training cameras by a method, each relative to all of them; None for a method that optimises
    no
    poses. cameras: the given ones of training photographs"""
    refined = method.refined(cameras)
    return None if refined is cameras else moves(cameras, refined, method.frame)
