"""Base of optimizers for tables of which a step touches some rows."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any

import torch
from torch import Tensor


class RowOptimizer(torch.optim.Optimizer):
    """Optimizer whose parameters are tables (row, ...), and which leaves alone what has no gradient, moments and all.

    A kind of it writes `moments` and `update`; `exchange` puts a table of other rows into a table's place.
    """

    @abstractmethod
    def moments(self, p: Tensor) -> dict[str, Tensor]:
        """Moments of a parameter before its first step."""

    @abstractmethod
    def update(self, p: Tensor, grad: Tensor, state: dict[str, Tensor], group: dict[str, Any]) -> None:
        """Take one step with a parameter and its moments, in place."""

    @torch.no_grad()
    def step(self, closure=None) -> None:  # type: ignore[override]  # nobody asks for a closure
        """Take one step with all parameters that have a gradient."""
        for group in self.param_groups:
            for p in group["params"]:
                if p.grad is None:
                    continue
                if not (state := self.state[p]):
                    state.update(self.moments(p))
                self.update(p, p.grad, state, group)


def adam_moments(p: Tensor) -> dict[str, Tensor]:
    """Adam's moments before the first step: steps taken, means of the gradient and of its square."""
    return {"step": torch.zeros(()), "mean": torch.zeros_like(p), "square": torch.zeros_like(p)}


def adam_rate(group: dict[str, Any], steps: float) -> float:
    """Learning rate times both bias corrections of Adam; epsilon is far below anything that they could change."""
    b1, b2 = group["betas"]
    return group["lr"] * math.sqrt(1 - b2**steps) / (1 - b1**steps)
