"""Adam with one step length for all coordinates of a mesh (Nicolet 2021, section 3.3)."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from ...components.training.row_optimizers import RowOptimizer, adam_moments, adam_rate


class UniformAdam(RowOptimizer):
    """Adam that divides by the root of the largest second moment instead of each coordinate's own.

    Steps so have the direction of the mean gradient. Adam would move vertices with small gradients as far as others,
    and along axes.
    """

    def __init__(self, params: Any, lr: float = 1e-2, betas: tuple[float, float] = (0.9, 0.999)):
        super().__init__(params, {"lr": lr, "betas": betas})

    def moments(self, p: Tensor) -> dict[str, Tensor]:
        return adam_moments(p)

    def update(self, p: Tensor, grad: Tensor, state: dict[str, Tensor], group: dict[str, Any]) -> None:
        b1, b2 = group["betas"]
        state["step"] += 1
        state["mean"].lerp_(grad, 1 - b1)
        state["square"].lerp_(grad.square(), 1 - b2)
        largest = state["square"].max().sqrt().clamp_min(1e-12)
        p.sub_(state["mean"] * (adam_rate(group, float(state["step"])) / largest))
