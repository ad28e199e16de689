"""What happens every so many steps in a long run, and often enough in a short one."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn


def intervals(step: int, progress: float, steps: int, share: float) -> float:
    """How many intervals are over, each as many steps long as a paper says, or such a share of the budget if that is
    sooner.

    step:     steps that are done
    progress: share of the budget that is spent, in [0, 1]
    """
    return max(step / steps, progress / share)


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

    def _load_from_state_dict(self, state: dict[str, Any], prefix: str, *rest: Any) -> None:
        state.setdefault(prefix + "over", self.over)  # runs that are older than this count from where they go on
        super()._load_from_state_dict(state, prefix, *rest)
