"""A cloud of Gaussians that learns, and whose number changes while it does."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numba import njit, prange
from torch import Tensor, nn

from ...gaussians import Gaussians
from ..training.exchange import exchange
from ..training.row_optimizer import RowOptimizer, adam_moments, adam_rate
from .witnesses import marked, witnesses

NAMES = ("means", "quaternions", "log_scales", "opacities", "harmonics")


class Cloud(nn.Module):
    """The tensors of `Gaussians` as parameters, and the photographs that saw each: a bit for each, see `witnesses`."""

    grows: ClassVar[tuple[str, ...]] = (*NAMES, "marks")  # with training, so that a saved one may be of another size

    means: nn.Parameter
    quaternions: nn.Parameter
    log_scales: nn.Parameter
    opacities: nn.Parameter
    harmonics: nn.Parameter
    marks: Tensor

    def __init__(self, gaussians: Gaussians):
        super().__init__()
        self.antialiased = gaussians.antialiased
        for name in NAMES:
            setattr(self, name, nn.Parameter(getattr(gaussians, name).clone()))
        self.register_buffer("marks", torch.zeros(len(gaussians), dtype=torch.int64))

    def __len__(self) -> int:
        return len(self.means)

    def gaussians(self) -> Gaussians:
        """The cloud; gradients flow back into the parameters."""
        return Gaussians(**{name: getattr(self, name) for name in NAMES}, antialiased=self.antialiased)

    @torch.no_grad()
    def replace(self, gaussians: Gaussians, optimizer: CloudAdam | None = None) -> None:
        """Put another cloud in this one's place; the optimizer updates it from now on, with fresh moments."""
        for name in NAMES:
            exchange(self, name, getattr(gaussians, name).detach().clone(), optimizer)
        self.marks = self.marks.new_zeros(len(gaussians))

    @torch.no_grad()
    def rebuild(self, optimizer: CloudAdam, source: Int[Tensor, " new"], fresh: Bool[Tensor, " new"]) -> None:
        """Make Gaussian i a copy of source[i]; the optimizer's moments of the fresh ones are zero.

        One operation for all that density control does: a clone is a number twice, a pruned one a number left out.
        """
        for name in NAMES:
            old = getattr(self, name)
            state = optimizer.state.get(old, {})
            if state:
                for moment in ("mean", "square", "last"):
                    state[moment] = state[moment][source]
                    state[moment][fresh] = state["step"] if moment == "last" else 0
            exchange(self, name, old.data[source], optimizer, state)
        self.marks = self.marks[source]

    def see(self, image_index: int, seen: Bool[Tensor, " gaussian"]) -> None:
        """Remember which Gaussians a photograph saw something of."""
        self.marks = marked(self.marks, image_index, seen)

    @property
    def seen_by(self) -> Int[Tensor, " gaussian"]:
        """How many photographs saw each Gaussian."""
        return witnesses(self.marks)


class CloudAdam(RowOptimizer):
    """Adam (Kingma and Ba 2015) that passes over a row while its whole gradient is exactly zero, and catches up later.

    Most Gaussians are not on most pictures. Adam would still move them, by what is left of their momentum, for steps
    after each time they were seen; to leave that out (as LazyAdam does) makes those that few photographs show ten times
    slower. Here a row that comes back after n steps has its moments decayed n times, and goes at once as far as its
    momentum will carry it in the n steps that it is likely to stay away: (1 - b1^n) / (1 - b1) times a step.
    Each group holds one parameter (row, ...); its "columns", if given, multiply the rate of each column.
    """

    def __init__(self, groups, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15):
        super().__init__(groups, {"lr": 0.0, "betas": betas, "eps": eps, "columns": None})

    def moments(self, p):
        return adam_moments(p) | {"last": torch.zeros(len(p), device=p.device)}  # step at which each row was moved

    def update(self, p, grad, state, group):
        state["step"] += 1
        (b1, b2), t = group["betas"], float(state["step"])
        width = math.prod(p.shape[1:])
        rates = adam_rate(group, t) * torch.tensor(group["columns"] or [1.0] * width, device=p.device)
        given = p, grad.contiguous(), state["mean"], state["square"]
        values, grad, mean, square = (x.detach().view(-1, width) for x in given)
        if p.is_cuda:
            _rows(values, grad, mean, square, state["last"], rates, t, b1, b2, group["eps"])
        else:
            tensors = values, grad, mean, square, state["last"], rates
            _rows_cpu(*(x.numpy() for x in tensors), np.float32(t), _powers(b1), _powers(b2), np.float32(group["eps"]))


@lru_cache
def _powers(base: float, count: int = 1 << 14) -> np.ndarray:
    """A table of base^n for n from 0, quicker to read than a power; after its last entry a moment is nothing."""
    return (base ** np.arange(count)).astype(np.float32)


def _rows(
    p: Float[Tensor, "row column"],
    grad: Float[Tensor, "row column"],
    mean: Float[Tensor, "row column"],
    square: Float[Tensor, "row column"],
    last: Float[Tensor, " row"],
    rates: Float[Tensor, " column"],
    t: float,
    b1: float,
    b2: float,
    eps: float,
) -> None:
    touched = (grad != 0).any(-1, keepdim=True)
    kept1, kept2 = b1 ** (t - last)[:, None], b2 ** (t - last)[:, None]
    mean.copy_(torch.where(touched, kept1 * mean + (1 - b1) * grad, mean))
    square.copy_(torch.where(touched, kept2 * square + (1 - b2) * grad * grad, square))
    far = rates * (1 - kept1) / (1 - b1)
    p.copy_(torch.where(touched, p - far * mean / (square.sqrt() + eps), p))
    last.copy_(torch.where(touched[:, 0], t, last))


@njit(parallel=True, fastmath=True, cache=True)
def _rows_cpu(p, grad, mean, square, last, rates, t, powers1, powers2, eps):
    one, width = np.float32(1), p.shape[1]
    b1, b2 = powers1[1], powers2[1]
    for i in prange(len(p)):
        size = np.float32(0)
        for j in range(width):
            size += abs(grad[i, j])
        if size > 0:
            away = min(np.int64(t - last[i]), len(powers1) - 1)
            kept1, kept2 = powers1[away], powers2[away]
            far = (one - kept1) / (one - b1)
            last[i] = t
            for j in range(width):
                g = grad[i, j]
                mean[i, j] = kept1 * mean[i, j] + (one - b1) * g
                square[i, j] = kept2 * square[i, j] + (one - b2) * g * g
                p[i, j] -= far * rates[j] * mean[i, j] / (np.sqrt(square[i, j]) + eps)
