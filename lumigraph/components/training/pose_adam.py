"""Adam for poses: each row one photograph's, with one rate for all directions that it may move in."""

from __future__ import annotations

import torch


class PoseAdam(torch.optim.Optimizer):
    """Adam (Kingma and Ba 2015) with one second moment for each row, that of its gradient's length.

    So a row moves as its gradient points, as far as `lr` at most. Adam's own second moments, one for each number, would
    move directions that little is known of as fast as those that the photographs tell clearly. A row whose gradient is
    all zero was not looked at: it stays, and its moments are those of the steps that did.
    """

    def __init__(self, params, lr: float = 1e-3, betas: tuple[float, float] = (0.9, 0.95)):
        super().__init__(params, {"lr": lr, "betas": betas})

    @torch.no_grad()
    def step(self, closure=None) -> None:  # type: ignore[override]  # nobody asks for a closure
        """Take one step with all rows that have a gradient."""
        for group in self.param_groups:
            for p in group["params"]:
                if p.grad is not None:
                    self._update(p, p.grad, group["lr"], *group["betas"])

    def _update(self, p: torch.Tensor, grads: torch.Tensor, lr: float, b1: float, b2: float) -> None:
        state = self.state[p]
        if not state:
            state["mean"] = torch.zeros_like(p)
            state["square"], state["steps"] = torch.zeros_like(p[:, 0]), torch.zeros_like(p[:, 0])
        seen = grads.ne(0).any(-1).nonzero()[:, 0]
        grad = grads[seen]
        steps = state["steps"][seen] + 1
        mean = torch.lerp(grad, state["mean"][seen], b1)
        square = torch.lerp(grad.square().sum(-1), state["square"][seen], b2)
        state["steps"][seen], state["mean"][seen], state["square"][seen] = steps, mean, square
        length = (square / (1 - b2**steps)).sqrt().clamp_min(1e-30)
        p[seen] -= lr * mean / ((1 - b1**steps) * length)[:, None]
