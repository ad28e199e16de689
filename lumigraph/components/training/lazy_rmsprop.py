"""RMSprop for tables of which each step touches some rows."""

from __future__ import annotations

import numpy as np
import torch
from numba import njit, prange

from .row_optimizer import RowOptimizer


class LazyRMSprop(RowOptimizer):
    """RMSprop (Hinton 2012) that looks at no row but those that a sparse gradient names:

        s = beta s + (1 - beta) g^2,    p = p - lr g / (sqrt(s) + eps)

    An element's first gradient begins its mean: s = g^2, as in the release of Fridovich-Keil and Yu (2022), whose
    numbers the defaults are. Each parameter is a table (row, column). A sparse gradient names each row once, as that of
    `torch.nn.functional.embedding(rows, table, sparse=True)` with rows that all differ; of a dense one all rows count.
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
