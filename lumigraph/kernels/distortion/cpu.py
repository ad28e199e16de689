"""Numba: one thread takes a run of rays."""

import numpy as np
from numba import njit, prange

from .._operation import differentiable, empty

THIRD = np.float32(1 / 3)


@njit(parallel=True, fastmath=True, cache=True)
def _forward(weights, middles, lengths, starts, total):
    """Losses: pairs with earlier samples sum to 2 w_i (m_i W - M), W and M sums of w_j and w_j m_j over j < i."""
    for r in prange(len(starts) - 1):
        weight, moment, found = np.float32(0), np.float32(0), np.float32(0)
        for i in range(starts[r], starts[r + 1]):
            w, m = weights[i], middles[i]
            found += w * (2 * (m * weight - moment) + THIRD * w * lengths[i])
            weight += w
            moment += w * m
        total[r] = found


@njit(parallel=True, fastmath=True, cache=True)
def _backward(to_total, weights, middles, lengths, starts, to_weights):
    for r in prange(len(starts) - 1):
        weight, moment = np.float32(0), np.float32(0)  # before i, less those behind it
        for i in range(starts[r], starts[r + 1]):
            weight -= weights[i]
            moment -= weights[i] * middles[i]
        for i in range(starts[r], starts[r + 1]):
            w, m = weights[i], middles[i]
            weight += w
            moment += w * m
            to_weights[i] = 2 * to_total[r] * (m * weight - moment + THIRD * w * lengths[i])
            weight += w
            moment += w * m


def forward(ctx, weights, middles, lengths, starts):
    total = empty(len(starts) - 1)
    _forward(*(x.detach().numpy() for x in (weights, middles, lengths, starts)), total.numpy())
    ctx.save_for_backward(weights, middles, lengths, starts)
    return total


def backward(ctx, to_total):
    saved = [x.detach().numpy() for x in ctx.saved_tensors]
    to_weights = empty(len(saved[0]))
    _backward(to_total.numpy(), *saved, to_weights.numpy())
    return to_weights, None, None, None


run = differentiable(forward, backward)
