"""Activations whose gradients are limited."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

LIMIT = 15.0


class _TruncatedExp(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(y := x.clamp(max=2 * LIMIT).exp())
        return y

    @staticmethod
    def backward(ctx, grad):
        (y,) = ctx.saved_tensors
        return grad * y.clamp(max=2.718281828459045**LIMIT)


def truncated_exp(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """exp(x), with a gradient no steeper than e^15, so that one dense sample cannot blow up a step (Müller 2022)."""
    return _TruncatedExp.apply(x)
