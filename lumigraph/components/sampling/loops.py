"""Loops over the bins of rays on the CPU, without a tensor for each term (Numba)."""

import numpy as np
from numba import njit, prange

ZERO, ONE = np.float32(0), np.float32(1)


@njit(parallel=True, cache=True, error_model="numpy")
def invert(edges, weights, shares, faint, found):
    """Loop of `sampling.inverse_of`. faint: weight added to every bin"""
    bins = weights.shape[1]
    for ray in prange(len(weights)):
        total = 0.0
        for k in range(bins):
            total += weights[ray, k] + np.float32(faint)
        total = 1 / total
        b, below, low, high = 0, 0.0, ZERO, np.float32((weights[ray, 0] + np.float32(faint)) * total)
        for k in range(shares.shape[1]):
            share = shares[ray, k]
            if share < low:
                b, below, low, high = 0, 0.0, ZERO, np.float32((weights[ray, 0] + np.float32(faint)) * total)
            while high <= share and b < bins - 1:
                below += (weights[ray, b] + np.float32(faint)) * total
                b += 1
                low = np.float32(below)
                high = np.float32(below + (weights[ray, b] + np.float32(faint)) * total)
            along = min(max((share - low) / max(high - low, np.float32(1e-12)), ZERO), ONE)
            found[ray, k] = edges[ray, b] + along * (edges[ray, b + 1] - edges[ray, b])


@njit(parallel=True, cache=True, error_model="numpy")
def sum_excess(found, bins, edges, w, little, excess, slope):
    """Loop of `proposal.excess_of` and its gradient. little: weight treated as zero"""
    count = found.shape[1]
    for ray in prange(len(w)):
        below = np.zeros(count + 1)
        for b in range(count):
            below[b + 1] = below[b] + found[ray, b]
        steps = np.zeros(count + 1)
        total, first, last = ZERO, 0, 0
        for i in range(w.shape[1]):
            start, end = edges[ray, i], edges[ray, i + 1]
            while first < count and bins[ray, first + 1] <= start:
                first += 1
            while last < count and bins[ray, last] < end:
                last += 1
            over = w[ray, i] - (np.float32(below[last]) - np.float32(below[first]))
            if over > ZERO:
                share = over / (w[ray, i] + np.float32(little))
                total += over * share
                steps[first] -= np.float32(2) * share
                steps[last] += np.float32(2) * share
        excess[ray] = total
        running = 0.0
        for b in range(count):
            running += steps[b]
            slope[ray, b] = running
