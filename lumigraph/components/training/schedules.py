"""Learning rates as functions of the share of the budget that is spent."""

from __future__ import annotations

from typing import Any

FIRST_SHARE = 0.01  # of the learning rate, at the very beginning of a warm-up
RISE = 20  # steps in which a rate that is held rises


def falling(first: float, last: float, progress: float, warmup: float = 0.0) -> float:
    """The learning rate that falls from first to last exponentially, after growing for a share `warmup` of the budget.

    progress: share of the budget that is spent, in [0, 1]
    """
    rate = first * (last / first) ** progress if first else 0.0
    return rate * (FIRST_SHARE + (1 - FIRST_SHARE) * min(1.0, progress / warmup) if warmup else 1.0)


def held(first: float, last: float, step: int, progress: float, start: float) -> float:
    """The learning rate that rises for twenty steps, is constant until a share `start` of the budget is spent, and
    falls to `last` exponentially.

    progress: share of the budget that is spent, in [0, 1]
    """
    fall = max(0.0, progress - start) / (1 - start)
    return falling(first, last, fall) * min(1.0, (step + 1) / RISE)


def exponential_decay(method: Any, step: int, progress: float) -> float:
    """`Method.learning_rate` that is `falling`, by the numbers of the Config."""
    c = method.config
    return falling(c.learning_rate, c.final_learning_rate, progress, getattr(c, "warmup", 0.0))


def held_decay(method: Any, step: int, progress: float) -> float:
    """`Method.learning_rate` that is `held`, by the numbers of the Config."""
    c = method.config
    return held(c.learning_rate, c.final_learning_rate, step, progress, c.decay_start)
