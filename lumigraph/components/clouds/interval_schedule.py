"""Schedules in steps that adapt to short runs: intervals and learning rates."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


def intervals(step: int, progress: float, steps: int, share: float) -> float:
    """Number of completed intervals, of the paper's number of steps, or of a share of the budget if that is shorter.

    step:     number of completed steps
    progress: spent share of the budget, in [0, 1]
    """
    return max(step / steps, progress / share)


def short_schedule_lr_scale(step: int, progress: float, full_schedule: int, max_scale: float) -> float:
    """Factor on learning rates in short runs: (full_schedule / steps)^(1/2), from 1 to `max_scale`.

    In n steps a parameter then moves as far as a random walk would in `full_schedule`. The total number of steps is
    extrapolated from the completed ones; before the first it is unknown and the factor is 1.
    full_schedule: number of steps from which on the factor is 1
    """
    return min(max_scale, max(1.0, math.sqrt(full_schedule * progress / step))) if step else 1.0


class IntervalSchedule(nn.Module):
    """Counter of completed intervals; see `intervals`. A resumed run continues counting."""

    over: Tensor

    def __init__(self, steps: int, share: float):
        super().__init__()
        self.steps, self.share = steps, share
        self.register_buffer("over", torch.tensor(-1))

    def due(self, step: int, progress: float) -> bool:
        """True if an interval has ended since the last call."""
        over = int(intervals(step, progress, self.steps, self.share))
        ended = over > int(self.over) >= 0
        self.over.fill_(over)
        return ended
