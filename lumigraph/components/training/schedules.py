"""Schedules over the budget: learning rates, and coarse-to-fine weights of an encoding's bands."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...method import Part

FIRST_SHARE = 0.01  # of the learning rate, at the very beginning of a warm-up
RISE = 20  # steps in which a rate that is held rises, unless a Config says otherwise


def falling(first: float, last: float, progress: float, warmup: float = 0.0) -> float:
    """Learning rate that decays exponentially from first to last, after a warm-up over a share of the budget.

    progress: spent share of the budget, in [0, 1]
    """
    rate = first * (last / first) ** progress if first else 0.0
    return rate * (FIRST_SHARE + (1 - FIRST_SHARE) * min(1.0, progress / warmup) if warmup else 1.0)


def hold_and_decay(first: float, last: float, step: int, progress: float, start: float, rise: int = RISE) -> float:
    """Learning rate with a warm-up of some steps, constant until a share `start` of the budget is spent, then decaying
    exponentially to `last`.

    progress: spent share of the budget, in [0, 1]
    rise:     steps of the warm-up
    """
    fall = max(0.0, progress - start) / (1 - start)
    return falling(first, last, fall) * min(1.0, (step + 1) / rise)


def exponential_decay(method: Any, step: int, progress: float) -> float:
    """`Method.learning_rate` that is `falling`, by the numbers of the Config."""
    c = method.config
    return falling(c.learning_rate, c.final_learning_rate, progress, getattr(c, "warmup", 0.0))


def held_decay(method: Any, step: int, progress: float) -> float:
    """`Method.learning_rate` that is `hold_and_decay`, by the numbers of the Config or of its backbone."""
    c, rise = getattr(method.config, "backbone", method.config), getattr(method.config, "warmup_steps", RISE)
    return hold_and_decay(c.learning_rate, c.final_learning_rate, step, progress, c.decay_start, rise)


INITIAL_BANDS = 1 / 4  # share of the bands that are there from the beginning
BEGINS, ENDS = 0.05, 0.4  # shares of the budget between which the others join


def band_weights(count: int, progress: float, begins: float = BEGINS, ends: float = ENDS) -> Float[Tensor, " band"]:
    """Coarse-to-fine weights in [0, 1] of an encoding's bands, the coarsest first (Lin 2021, BARF, eq. 14).

        w_k = 0 for alpha < k,  (1 - cos((alpha - k) pi)) / 2 for alpha - k in [0, 1),  1 beyond

    count:    number of bands: octaves of waves, levels of a hash table
    progress: spent share of the budget; alpha grows linearly with it, from INITIAL_BANDS of them to all, between the
              shares `begins` and `ends`
    """
    grown = min(max((progress - begins) / (ends - begins), 0.0), 1.0)
    first = max(1.0, INITIAL_BANDS * count)
    alpha = first + grown * (count - first)
    return (1 - torch.cos(math.pi * (alpha - torch.arange(count)).clamp(0, 1))) / 2


class BandSchedule(Part):
    """Coarse-to-fine schedule of an encoding's bands over a share of the budget (Yang 2023, eq. 2).

    joined: its progress, saved because a run that stopped early renders as it was trained
    """

    joined: Tensor

    def __init__(self, share: float):
        super().__init__()
        self.share = share
        self.register_buffer("joined", torch.zeros(()))

    def before_step(self, method: object, step: int, progress: float) -> None:
        self.joined.fill_(max(float(self.joined), min(progress / self.share, 1.0)))

    def weights(self, bands: int) -> Float[Tensor, " band"] | None:
        """Weights of `bands` bands; None when all are 1."""
        joined = float(self.joined)
        return band_weights(bands, joined, 0.0, 1.0).to(self.joined.device) if joined < 1 else None


def joining_of(*schedules: Any) -> Callable[[int], Float[Tensor, " band"] | None] | None:
    """Weights of bands by the first part with a schedule of them; None without one."""
    return next((part.weights for part in schedules if part), None)
