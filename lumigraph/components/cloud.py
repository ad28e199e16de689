"""A cloud of Gaussians that learns, and whose number changes while it does."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numba import njit, prange
from torch import Tensor, nn

from ..gaussians import Gaussians

NAMES = ("means", "quaternions", "log_scales", "opacities", "harmonics")


class Cloud(nn.Module):
    """The tensors of `Gaussians` as parameters. Loading a state of another size resizes them."""

    means: nn.Parameter
    quaternions: nn.Parameter
    log_scales: nn.Parameter
    opacities: nn.Parameter
    harmonics: nn.Parameter

    def __init__(self, gaussians: Gaussians):
        super().__init__()
        self.antialiased = gaussians.antialiased
        for name in NAMES:
            setattr(self, name, nn.Parameter(getattr(gaussians, name).clone()))

    def __len__(self) -> int:
        return len(self.means)

    def gaussians(self) -> Gaussians:
        """The cloud as it is; gradients flow back into the parameters."""
        return Gaussians(**{name: getattr(self, name) for name in NAMES}, antialiased=self.antialiased)

    @torch.no_grad()
    def replace(self, gaussians: Gaussians, optimizer: CloudAdam | None = None) -> None:
        """Another cloud in this one's place, which the optimizer is to move from now on, without any memory."""
        for name in NAMES:
            self._exchange(name, getattr(gaussians, name).detach().clone(), optimizer)

    @torch.no_grad()
    def rebuild(self, optimizer: CloudAdam, source: Int[Tensor, " new"], fresh: Bool[Tensor, " new"]) -> None:
        """New Gaussian i is a copy of source[i]; the optimizer has no memory of the fresh ones.

        One operation for all that density control does: a clone is a number twice, a pruned one a number left out.
        """
        for name in NAMES:
            old = getattr(self, name)
            state = optimizer.state.get(old, {})
            for moment in ("mean", "square"):
                if moment in state:
                    state[moment] = state[moment][source]
                    state[moment][fresh] = 0
            self._exchange(name, old.data[source], optimizer, state)

    def _exchange(self, name: str, values: Tensor, optimizer: CloudAdam | None, state: dict | None = None) -> None:
        """A new parameter for an old one, whose size the graph of the last step still remembers."""
        old = getattr(self, name)
        new = nn.Parameter(values.to(old.device))
        setattr(self, name, new)
        if optimizer is not None:
            optimizer.state.pop(old, None)
            if state:
                optimizer.state[new] = state
            for group in optimizer.param_groups:
                group["params"] = [new if p is old else p for p in group["params"]]

    def _load_from_state_dict(self, state_dict, prefix, *rest):
        for name in NAMES:
            parameter, saved = getattr(self, name), state_dict.get(prefix + name)
            if saved is not None and saved.shape != parameter.shape:
                setattr(self, name, nn.Parameter(parameter.data.new_empty(saved.shape)))
        super()._load_from_state_dict(state_dict, prefix, *rest)


class CloudAdam(torch.optim.Optimizer):
    """Adam (Kingma and Ba 2015) that leaves a row alone, moments and all, where its whole gradient is exactly zero.

    So Gaussians that a picture does not show neither drift nor cost arithmetic (Mallick 2024 keeps to the visible
    likewise). Each group holds one parameter (row, ...); its "columns", if given, multiply the rate of each column.
    """

    def __init__(self, groups, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15):
        super().__init__(groups, {"lr": 0.0, "betas": betas, "eps": eps, "columns": None})

    @torch.no_grad()
    def step(self, closure=None) -> None:  # type: ignore[override]  # nobody asks for a closure
        """One step of all parameters that have a gradient."""
        for group in self.param_groups:
            for p in group["params"]:
                if p.grad is not None:
                    self._update(p, group)

    def _update(self, p, group):
        state = self.state[p]
        if not state:
            state["step"] = torch.zeros(())
            state["mean"], state["square"] = torch.zeros_like(p), torch.zeros_like(p)
        state["step"] += 1
        (b1, b2), t = group["betas"], float(state["step"])
        rate = group["lr"] * math.sqrt(1 - b2**t) / (1 - b1**t)
        width = math.prod(p.shape[1:])
        rates = rate * torch.tensor(group["columns"] or [1.0] * width, device=p.device)
        given = p, p.grad.contiguous(), state["mean"], state["square"]
        values, grad, mean, square = (x.detach().view(-1, width) for x in given)
        if p.is_cuda:
            _rows(values, grad, mean, square, rates, b1, b2, group["eps"])
        else:
            numbers = (np.float32(x) for x in (b1, b2, group["eps"]))
            _rows_cpu(*(x.numpy() for x in (values, grad, mean, square, rates)), *numbers)


def _rows(
    p: Float[Tensor, "row column"],
    grad: Float[Tensor, "row column"],
    mean: Float[Tensor, "row column"],
    square: Float[Tensor, "row column"],
    rates: Float[Tensor, " column"],
    b1: float,
    b2: float,
    eps: float,
) -> None:
    touched = (grad != 0).any(-1, keepdim=True)
    mean.copy_(torch.where(touched, b1 * mean + (1 - b1) * grad, mean))
    square.copy_(torch.where(touched, b2 * square + (1 - b2) * grad * grad, square))
    p.copy_(torch.where(touched, p - rates * mean / (square.sqrt() + eps), p))


@njit(parallel=True, fastmath=True, cache=True)
def _rows_cpu(p, grad, mean, square, rates, b1, b2, eps):
    one, width = np.float32(1), p.shape[1]
    for i in prange(len(p)):
        size = np.float32(0)
        for j in range(width):
            size += abs(grad[i, j])
        if size > 0:
            for j in range(width):
                g = grad[i, j]
                mean[i, j] = b1 * mean[i, j] + (one - b1) * g
                square[i, j] = b2 * square[i, j] + (one - b2) * g * g
                p[i, j] -= rates[j] * mean[i, j] / (np.sqrt(square[i, j]) + eps)
