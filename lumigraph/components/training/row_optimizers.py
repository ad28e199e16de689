"""Optimizers for tables with sparse row gradients, and replacement of a table by one of another size."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor, nn

from ...kernels._lanes import LANES, fetch, put, root, some, where


class RowOptimizer(torch.optim.Optimizer):
    """Optimizer of tables (row, ...) that skips rows without a gradient, moments included.

    Subclasses write `moments` and `update`; `exchange` replaces a table by one with other rows.
    """

    @abstractmethod
    def moments(self, p: Tensor) -> dict[str, Tensor]:
        """Initial moments of a parameter."""

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
    """Adam's initial moments: step count, means of the gradient and of its square."""
    return {"step": torch.zeros(()), "mean": torch.zeros_like(p), "square": torch.zeros_like(p)}


def adam_rate(group: dict[str, Any], steps: float) -> float:
    """Learning rate times both bias corrections of Adam; epsilon is negligible in them."""
    b1, b2 = group["betas"]
    return group["lr"] * math.sqrt(1 - b2**steps) / (1 - b1**steps)


def exchange(
    module: nn.Module,
    name: str,
    values: Tensor,
    optimizer: torch.optim.Optimizer | None,
    state: dict[str, Any] | None = None,
) -> None:
    """Replace a module's parameter by a new one of another size; the last step's graph still refers to the old one.

    optimizer: updates the new one from now on; None before training
    state:     its state for the new one; by default none, so that moments are zero
    """
    old = getattr(module, name)
    new = nn.Parameter(values.to(old.device))
    setattr(module, name, new)
    if optimizer is not None:
        optimizer.state.pop(old, None)
        if state:
            optimizer.state[new] = state
        for group in optimizer.param_groups:
            group["params"] = [new if p is old else p for p in group["params"]]


CHUNK = 1 << 12  # elements that a thread takes at a time


class LazyAdam(RowOptimizer):
    """Adam (Kingma and Ba 2015) that skips elements of exactly zero gradient, moments included.

    So a hash table's entries that no sample touched do not drift (Müller 2022, section 4). Defaults are that paper's.
    weight_decay: decoupled (Loshchilov and Hutter 2019): each step takes lr * weight_decay of the updated elements
    A group's "rates", if given, multiply the rate of each row of its parameters.
    """

    def __init__(
        self,
        params,
        lr: float = 1e-2,
        betas: tuple[float, float] = (0.9, 0.99),
        eps: float = 1e-15,
        weight_decay: float = 0.0,
    ):
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps, "weight_decay": weight_decay, "rates": None})

    def moments(self, p):
        return adam_moments(p)

    def update(self, p, grad, state, group):
        state["step"] += 1
        (b1, b2), rate = group["betas"], adam_rate(group, float(state["step"]))
        keep = 1 - group["lr"] * group["weight_decay"]
        tensors, rates = (p, grad, state["mean"], state["square"]), group["rates"]
        if rates is not None and len(rates) != len(p):
            raise ValueError(f"{len(rates)} rates are given for {len(p)} rows")
        if p.is_cuda:
            from ...kernels._row_optimizers import lazy_adam

            lazy_adam(*tensors, rates, rate, b1, b2, group["eps"], keep)
            return
        numbers = [np.float32(x) for x in (rate, b1, b2, group["eps"], keep)]
        arrays = [x.detach().view(-1).numpy() for x in tensors]
        if rates is None:
            _touched_cpu(*arrays, *numbers)
        else:
            _touched_rows_cpu(*arrays, rates.numpy(), *numbers)


@njit(inline="always")
def _move(p, grad, mean, square, i, rate, b1, b2, eps, keep):
    g, one = grad[i], np.float32(1)
    if g != 0:
        mean[i] = b1 * mean[i] + (one - b1) * g
        square[i] = b2 * square[i] + (one - b2) * g * g
        p[i] = keep * p[i] - rate * mean[i] / (np.sqrt(square[i]) + eps)


@njit(parallel=True, fastmath={"contract", "nsz", "arcp"}, error_model="numpy", cache=True)
def _touched_cpu(p, grad, mean, square, rate, b1, b2, eps, keep):
    zero, one = np.float32(0), np.float32(1)
    for chunk in prange((len(p) + CHUNK - 1) // CHUNK):
        first, last = chunk * CHUNK, min(len(p), (chunk + 1) * CHUNK)
        whole = last - (last - first) % LANES
        for i in range(first, whole, LANES):
            g = fetch(grad, i)
            touched = g != zero
            if some(touched):
                old, old_mean, old_square = fetch(p, i), fetch(mean, i), fetch(square, i)
                m, s = b1 * old_mean + (one - b1) * g, b2 * old_square + (one - b2) * g * g
                put(mean, i, where(touched, m, old_mean))
                put(square, i, where(touched, s, old_square))
                put(p, i, where(touched, keep * old - rate * m / (root(s) + eps), old))
        for i in range(whole, last):
            _move(p, grad, mean, square, i, rate, b1, b2, eps, keep)


@njit(parallel=True, fastmath=True, cache=True)
def _touched_rows_cpu(p, grad, mean, square, rates, rate, b1, b2, eps, keep):
    width = len(p) // len(rates)
    for row in prange(len(rates)):
        if rates[row] > 0:
            for i in range(row * width, (row + 1) * width):
                _move(p, grad, mean, square, i, rate * rates[row], b1, b2, eps, keep)


class LazyRMSprop(RowOptimizer):
    """RMSprop (Hinton 2012) that updates only the rows of a sparse gradient:

        s = beta s + (1 - beta) g^2,    p = p - lr g / (sqrt(s) + eps)

    An element's first gradient initialises its mean: s = g^2, as in the release of Fridovich-Keil and Yu (2022), the
    source of the defaults. Each parameter is a table (row, column). A sparse gradient names each row once, as that of
    `torch.nn.functional.embedding(rows, table, sparse=True)` with distinct rows; of a dense one all rows count.
    """

    def __init__(self, params, lr: float = 1e-2, beta: float = 0.95, eps: float = 1e-8):
        super().__init__(params, {"lr": lr, "beta": beta, "eps": eps})

    def moments(self, p):
        return {"square": torch.zeros_like(p)}

    def update(self, p, grad, state, group):
        numbers = group["lr"], group["beta"], group["eps"]
        if grad.is_sparse:
            rows, grad = grad._indices()[0], grad._values().contiguous()
        else:
            rows, grad = torch.arange(len(p), device=p.device), grad.contiguous()
        if p.is_cuda:
            _rows(p, rows, grad, state["square"], *numbers)
        else:
            tensors = (x.detach().numpy() for x in (p, rows, grad, state["square"]))
            _rows_cpu(*tensors, *(np.float32(x) for x in numbers))


def _rows(p, rows, grad, square, rate, beta, eps):
    old = square[rows]
    new = torch.where(old == 0, grad * grad, beta * old + (1 - beta) * grad * grad)
    square[rows] = new
    p[rows] -= rate * grad / (new.sqrt() + eps)


@njit(parallel=True, fastmath=True, cache=True)
def _rows_cpu(p, rows, grad, square, rate, beta, eps):
    zero, one = np.float32(0), np.float32(1)
    for i in prange(len(rows)):
        row = rows[i]
        for c in range(p.shape[1]):
            g, old = grad[i, c], square[row, c]
            new = g * g if old == zero else beta * old + (one - beta) * g * g
            square[row, c] = new
            p[row, c] -= rate * g / (np.sqrt(new) + eps)
