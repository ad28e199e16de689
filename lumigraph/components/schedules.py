"""How a learning rate changes with the share of the budget that is spent."""

from __future__ import annotations

from collections.abc import Iterable

import torch

FIRST_SHARE = 0.01  # of the learning rate, at the very beginning of a warm-up


def falling(first: float, last: float, progress: float, warm_up: float = 0.0) -> float:
    """From first to last exponentially, after growing for a share `warm_up` of the budget.

    progress: share of the budget that is spent, in [0, 1]
    """
    rate = first * (last / first) ** progress
    return rate * (FIRST_SHARE + (1 - FIRST_SHARE) * min(1.0, progress / warm_up) if warm_up else 1.0)


def set_learning_rate(optimizers: Iterable[torch.optim.Optimizer], rate: float) -> None:
    """Give all groups a learning rate, times their own "scale" where they have one."""
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            group["lr"] = rate * group.get("scale", 1.0)
