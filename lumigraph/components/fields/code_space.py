"""Codes that were learnt, as a Gaussian: which way they differ, and the one like them that evidence asks for."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor


def axes_of(codes: Float[Tensor, "known code"], least: float = 0.0) -> Float[Tensor, "axis code"]:
    """Along which codes differ, each as long as their deviation along it: their mean plus `w @ axes` is distributed as
    the Gaussian that fits them, where w is of the standard normal distribution. None for fewer than two codes.

    least: deviation that every axis has besides; above 0 there are as many axes as numbers
    """
    if len(codes) < 2:
        return codes[:0]
    off = (codes - codes.mean(0)) / (len(codes) - 1) ** 0.5
    _, found, along = torch.linalg.svd(off, full_matrices=least > 0)
    deviation = (torch.cat([found, found.new_zeros(len(along) - len(found))]).square() + least**2).sqrt()
    return (deviation[:, None] * along)[deviation > 1e-4 * deviation[:1].clamp_min(1e-9)]


def fitted(
    start: Float[Tensor, " width"],
    error: Callable[[Float[Tensor, " width"]], Tensor],
    steps: int,
    learning_rate: float,
) -> Float[Tensor, " width"]:
    """The numbers that make an error small, by so many steps of Adam from a start, with all else as it is.

    error: a number that is differentiable in them
    """
    with torch.enable_grad():
        code = start.detach().clone().requires_grad_()
        adam = torch.optim.Adam([code], learning_rate)
        for step in range(steps):
            (code.grad,) = torch.autograd.grad(error(code), [code])
            adam.param_groups[0]["lr"] = learning_rate * (1 - step / steps)
            adam.step()
    return code.detach()
