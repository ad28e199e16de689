"""Numba: one thread takes a run of rays."""

import numpy as np
from numba import njit, prange

from .._operation import differentiable, empty

ONE = np.float32(1)


@njit(parallel=True, fastmath=True, cache=True)
def _forward(tau, values, starts, stop, total, opacity, weights):
    channels = values.shape[1]
    for r in prange(len(starts) - 1):
        transmittance, sum_w = ONE, np.float32(0)
        total[r] = 0
        for i in range(starts[r], starts[r + 1]):
            if transmittance < stop:
                weights[i] = 0
                continue
            exp_tau = np.exp(-tau[i])
            w = transmittance * (ONE - exp_tau)
            weights[i] = w
            sum_w += w
            transmittance *= exp_tau
            for c in range(channels):
                total[r, c] += w * values[i, c]
        opacity[r] = sum_w


@njit(parallel=True, fastmath=True, cache=True)
def _backward(to_total, to_opacity, to_weights, tau, values, weights, starts, stop, to_tau, to_values):
    """Gradients: dL/dtau_i = g_i T_{i+1} - sum_{j>i} g_j w_j with g_i = dL/dw_i."""
    channels = values.shape[1]
    for r in prange(len(starts) - 1):
        sum_gw = np.float32(0)
        for i in range(starts[r], starts[r + 1]):
            g = to_opacity[r] + to_weights[i]
            for c in range(channels):
                g += to_total[r, c] * values[i, c]
                to_values[i, c] = weights[i] * to_total[r, c]
            to_tau[i] = g
            sum_gw += g * weights[i]
        transmittance = ONE
        for i in range(starts[r], starts[r + 1]):
            if transmittance < stop:
                to_tau[i] = 0
                continue
            g = to_tau[i]
            sum_gw -= g * weights[i]
            transmittance *= np.exp(-tau[i])
            to_tau[i] = g * transmittance - sum_gw


def forward(ctx, tau, values, starts, stop):
    rays = len(starts) - 1
    total, opacity, weights = empty(rays, values.shape[1]), empty(rays), empty(len(tau))
    arrays = (x.detach().numpy() for x in (tau, values, starts))
    _forward(*arrays, np.float32(stop), total.numpy(), opacity.numpy(), weights.numpy())
    ctx.save_for_backward(tau, values, weights, starts)
    ctx.stop = stop
    return total, opacity, weights


def backward(ctx, *grads):
    saved = [x.detach().numpy() for x in ctx.saved_tensors]
    to_tau, to_values = (empty(*x.shape) for x in ctx.saved_tensors[:2])
    _backward(*(g.numpy() for g in grads), *saved, np.float32(ctx.stop), to_tau.numpy(), to_values.numpy())
    return to_tau, to_values, None, None


run = differentiable(forward, backward)
