"""Adam for poses: each row one photograph's, with one rate for all directions that it may move in."""

from __future__ import annotations

import torch

from .row_optimizer import RowOptimizer


class PoseAdam(RowOptimizer):
    """Adam (Kingma and Ba 2015) with one second moment for each row, that of its gradient's length.

    So a row moves as its gradient points, as far as `lr` at most. Adam's own second moments, one for each number, would
    move directions that little is known of as fast as those that the photographs tell clearly. A row whose gradient is
    all zero was not looked at: it stays, and its moments are those of the steps that did.
    """

    def __init__(self, params, lr: float = 1e-3, betas: tuple[float, float] = (0.9, 0.95)):
        super().__init__(params, {"lr": lr, "betas": betas})

    def moments(self, p):
        return {"mean": torch.zeros_like(p), "square": torch.zeros_like(p[:, 0]), "steps": torch.zeros_like(p[:, 0])}

    def update(self, p, grad, state, group):
        b1, b2 = group["betas"]
        seen = grad.ne(0).any(-1).nonzero()[:, 0]
        grad = grad[seen]
        steps = state["steps"][seen] + 1
        mean = torch.lerp(grad, state["mean"][seen], b1)
        square = torch.lerp(grad.square().sum(-1), state["square"][seen], b2)
        state["steps"][seen], state["mean"][seen], state["square"][seen] = steps, mean, square
        length = (square / (1 - b2**steps)).sqrt().clamp_min(1e-30)
        p[seen] -= group["lr"] * mean / ((1 - b1**steps) * length)[:, None]
