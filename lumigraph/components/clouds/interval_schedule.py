"""Schedules in steps that also hold for short runs: intervals and learning rates."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


def intervals(step: int, progress: float, steps: int, share: float) -> float:
    """Number of intervals that are over, each as many steps long as a paper says, or a share of the budget if that is
    sooner.

    step:     steps that are done
    progress: share of the budget that is spent, in [0, 1]
    """
    return max(step / steps, progress / share)


def short_schedule_lr_scale(step: int, progress: float, full_schedule: int, max_scale: float) -> float:
    """Factor on learning rates where the budget allows few steps: (full_schedule / steps)^(1/2), from 1 to `max_scale`.

    A parameter then comes as far in n steps as a random walk would in `full_schedule`. The number of steps that the
    budget allows follows from those that are done; before the first it is unknown and the factor is 1.
    full_schedule: steps from which on the factor is 1
    """
    return min(max_scale, max(1.0, math.sqrt(full_schedule * progress / step))) if step else 1.0


class IntervalSchedule(nn.Module):
    """Intervals as they end; see `intervals`. A resumed run goes on counting."""

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
