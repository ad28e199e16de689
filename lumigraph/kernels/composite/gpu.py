"""Triton: one program takes one ray, a block of samples at a time."""

import triton
import triton.language as tl

from .._gpu import launch
from .._operation import differentiable, empty

BLOCK = tl.constexpr(32)  # samples; most rays of a trained scene need one or two blocks


@triton.jit
def _thickness(tau, i, i0, b, sum_tau):
    """Each sample's tau, and the sum of tau in front of it, over tau_{i-1} because sum - tau_i would lose digits."""
    t = tl.load(tau + i, mask=i < b, other=0.0)
    previous = tl.load(tau + i - 1, mask=(i > i0) & (i < b), other=0.0)
    return t, sum_tau + tl.cumsum(previous, 0)


@triton.jit
def _forward(tau, values, ray_starts, outputs, stop, C: tl.constexpr, CHANNELS: tl.constexpr):
    total, opacity, weights = outputs
    r = tl.program_id(0).to(tl.int64)
    i0, b = tl.load(ray_starts + r), tl.load(ray_starts + r + 1)
    c = tl.arange(0, CHANNELS)
    sum_tau, sum_w = 0.0, 0.0
    sum_wv = tl.zeros([CHANNELS], tl.float32)
    while (i0 < b) & (tl.exp(-sum_tau) >= stop):
        i = i0 + tl.arange(0, BLOCK)
        t, in_front = _thickness(tau, i, i0, b, sum_tau)
        transmittance = tl.exp(-in_front)
        w = tl.where(transmittance < stop, 0.0, transmittance * (1 - tl.exp(-t)))
        tl.store(weights + i, w, mask=i < b)
        v = tl.load(values + i[:, None] * C + c[None, :], mask=(i < b)[:, None] & (c < C)[None, :], other=0.0)
        sum_wv += tl.sum(w[:, None] * v, 0)
        sum_w += tl.sum(w, 0)
        sum_tau += tl.sum(t, 0)
        i0 += BLOCK
    while i0 < b:  # out of sight
        i = i0 + tl.arange(0, BLOCK)
        tl.store(weights + i, tl.zeros([BLOCK], tl.float32), mask=i < b)
        i0 += BLOCK
    tl.store(total + r * C + c, sum_wv, mask=c < C)
    tl.store(opacity + r, sum_w)


@triton.jit
def _backward(grads, tau, values, ray_starts, outputs, d_tau, d_values, stop, C: tl.constexpr, CHANNELS: tl.constexpr):
    """Gradients: dL/dtau_i = g_i T_{i+1} - sum_{j>i} g_j w_j with g_i = dL/dw_i, dL/dv_i = w_i dL/dtotal."""
    d_total, d_opacity, d_weights = grads
    total, opacity, weights = outputs
    r = tl.program_id(0).to(tl.int64)
    a, b = tl.load(ray_starts + r), tl.load(ray_starts + r + 1)
    c = tl.arange(0, CHANNELS)
    g_total = tl.load(d_total + r * C + c, mask=c < C, other=0.0)
    g_opacity = tl.load(d_opacity + r)

    # sum of g_j w_j over the whole ray: two of its three parts are at hand
    sum_gw = tl.sum(g_total * tl.load(total + r * C + c, mask=c < C, other=0.0), 0) + g_opacity * tl.load(opacity + r)
    for i0 in range(a, b, BLOCK):
        i = i0 + tl.arange(0, BLOCK)
        g_w = tl.load(d_weights + i, mask=i < b, other=0.0) * tl.load(weights + i, mask=i < b, other=0.0)
        sum_gw += tl.sum(g_w, 0)

    sum_tau = 0.0
    for i0 in range(a, b, BLOCK):
        i = i0 + tl.arange(0, BLOCK)
        t, in_front = _thickness(tau, i, i0, b, sum_tau)
        w = tl.load(weights + i, mask=i < b, other=0.0)
        table = i[:, None] * C + c[None, :]
        there = (i < b)[:, None] & (c < C)[None, :]
        v = tl.load(values + table, mask=there, other=0.0)
        tl.store(d_values + table, w[:, None] * g_total[None, :], mask=there)
        g = tl.sum(v * g_total[None, :], 1) + g_opacity + tl.load(d_weights + i, mask=i < b, other=0.0)
        gw_behind = sum_gw - tl.cumsum(g * w, 0)
        seen = tl.exp(-in_front) >= stop
        tl.store(d_tau + i, tl.where(seen, g * tl.exp(-in_front - t) - gw_behind, 0.0), mask=i < b)
        sum_tau += tl.sum(t, 0)
        sum_gw -= tl.sum(g * w, 0)


def forward(ctx, tau, values, ray_starts, stop):
    rays, channels = len(ray_starts) - 1, values.shape[1]
    outputs = tuple(empty(*shape, device=tau.device) for shape in ((rays, channels), (rays,), (len(tau),)))
    ctx.sizes = {"C": channels, "CHANNELS": max(triton.next_power_of_2(channels), 1), "num_warps": 1}
    ctx.stop = stop
    launch(_forward, (rays,), tau, values, ray_starts, outputs, stop, **ctx.sizes)
    ctx.save_for_backward(tau, values, ray_starts, *outputs)
    return outputs


def backward(ctx, *grads):
    tau, values, ray_starts, *outputs = ctx.saved_tensors
    found = [empty(*x.shape, device=x.device) for x in (tau, values)]
    given = grads, tau, values, ray_starts, tuple(outputs), *found
    launch(_backward, (len(ray_starts) - 1,), *given, ctx.stop, **ctx.sizes)
    return *found, None, None


run = differentiable(forward, backward)
