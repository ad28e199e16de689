"""What happens every so many steps in a long run, and often enough in a short one."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


def intervals(step: int, progress: float, steps: int, share: float) -> float:
    """How many intervals are over, each as many steps long as a paper says, or such a share of the budget if that is
    sooner.

    step:     steps that are done
    progress: share of the budget that is spent, in [0, 1]
    """
    return max(step / steps, progress / share)


def haste(step: int, progress: float, enough: int, most: float) -> float:
    """How many times faster to learn where the budget allows few steps: (enough / steps)^(1/2), from 1 to `most`.

    A parameter then comes as far in n steps as a random walk would in `enough`. How many steps the budget allows is
    told by those that are done; before the first, nothing is known and the answer is 1.
    enough: steps from which on there is no need to hurry
    """
    return min(most, max(1.0, math.sqrt(enough * progress / step))) if step else 1.0


class Rhythm(nn.Module):
    """Says when one more interval is over; see `intervals`. A resumed run goes on counting."""

    over: Tensor

    def __init__(self, steps: int, share: float):
        super().__init__()
        self.steps, self.share = steps, share
        self.register_buffer("over", torch.tensor(-1))

    def due(self, step: int, progress: float) -> bool:
        """Whether an interval has ended since the last time this was asked."""
        over = int(intervals(step, progress, self.steps, self.share))
        ended = over > int(self.over) >= 0
        self.over.fill_(over)
        return ended
