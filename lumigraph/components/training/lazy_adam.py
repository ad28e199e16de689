"""Adam for tables of which each step touches a small part."""

from __future__ import annotations

import numpy as np
import torch
from numba import njit, prange

from .row_optimizer import RowOptimizer, adam_moments, adam_rate

BLOCK = 64  # elements that are passed over together where no gradient has a bit set


class LazyAdam(RowOptimizer):
    """Adam (Kingma and Ba 2015) that leaves an element alone, moments and all, where its gradient is exactly zero.

    So a hash table's entries that no sample touched do not drift (Müller 2022, section 4). Defaults are that paper's.
    weight_decay: decoupled (Loshchilov and Hutter 2019): each step takes lr * weight_decay of what it touches
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
            rate = rate if rates is None else rate * rates.view(-1, *[1] * (p.dim() - 1))
            _touched(*tensors, rate, b1, b2, group["eps"], keep)
            return
        numbers = [np.float32(x) for x in (rate, b1, b2, group["eps"], keep)]
        arrays = [x.detach().view(-1).numpy() for x in tensors]
        if rates is None:
            _touched_cpu(*arrays, *numbers)
        else:
            _touched_rows_cpu(*arrays, rates.numpy(), *numbers)


def _touched(p, grad, mean, square, rate, b1, b2, eps, keep):
    touched = grad != 0
    mean.copy_(torch.where(touched, b1 * mean + (1 - b1) * grad, mean))
    square.copy_(torch.where(touched, b2 * square + (1 - b2) * grad * grad, square))
    p.copy_(torch.where(touched, keep * p - rate * mean / (square.sqrt() + eps), p))


@njit(inline="always")
def _move(p, grad, mean, square, i, rate, b1, b2, eps, keep):
    g, one = grad[i], np.float32(1)
    if g != 0:
        mean[i] = b1 * mean[i] + (one - b1) * g
        square[i] = b2 * square[i] + (one - b2) * g * g
        p[i] = keep * p[i] - rate * mean[i] / (np.sqrt(square[i]) + eps)


@njit(parallel=True, fastmath=True, cache=True)
def _touched_cpu(p, grad, mean, square, rate, b1, b2, eps, keep):
    bits = grad.view(np.int32)
    for block in prange((len(p) + BLOCK - 1) // BLOCK):
        first, last = block * BLOCK, min(len(p), (block + 1) * BLOCK)
        some = np.int32(0)
        for i in range(first, last):
            some |= bits[i]
        if some:
            for i in range(first, last):
                _move(p, grad, mean, square, i, rate, b1, b2, eps, keep)


@njit(parallel=True, fastmath=True, cache=True)
def _touched_rows_cpu(p, grad, mean, square, rates, rate, b1, b2, eps, keep):
    width = len(p) // len(rates)
    for row in prange(len(rates)):
        if rates[row] > 0:
            for i in range(row * width, (row + 1) * width):
                _move(p, grad, mean, square, i, rate * rates[row], b1, b2, eps, keep)
