"""Sample positions along a ray: stratified, and by inverse transform of earlier weights."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from .loops import invert

FAINT = 1e-5  # weight that every bin has at least, so that no part of a ray is beyond reach


def stratified(
    rays: int, count: int, generator: torch.Generator | None = None, device: torch.device | str = "cpu"
) -> Float[Tensor, "ray {count}"]:
    """One number in each of `count` equal bins of [0, 1], ascending (Mildenhall 2020, eq. 2).

    generator: samples within bins; None takes their centres
    """
    if generator is None:
        offset = torch.full((rays, count), 0.5, device=device)
    else:
        offset = torch.rand(rays, count, generator=generator).to(device)
    return (torch.arange(count, device=device) + offset) / count


def inverse_transform(
    edges: Float[Tensor, "ray edge"], weights: Float[Tensor, "ray bin"], shares: Float[Tensor, "ray count"]
) -> Float[Tensor, "ray count"]:
    """Inverse transform sampling of a piecewise constant density (Mildenhall 2020, eq. 5).

    edges:   of the bins, ascending, one more than there are bins
    weights: of each bin, not negative
    shares:  in [0, 1], ascending, values of the cumulative distribution; see `stratified`
    """
    if loops_fit(edges, weights, shares):
        found = torch.empty_like(shares, memory_format=torch.contiguous_format)
        invert(*(x.contiguous().numpy() for x in (edges, weights, shares)), FAINT, found.numpy())
        return found
    return inverse_of(edges, weights, shares)


def inverse_of(
    edges: Float[Tensor, "ray edge"], weights: Float[Tensor, "ray bin"], shares: Float[Tensor, "ray count"]
) -> Float[Tensor, "ray count"]:
    """Reference implementation of `inverse_transform`, on any device and with gradients."""
    density = weights + FAINT
    below = torch.nn.functional.pad((density / density.sum(-1, keepdim=True)).cumsum(-1), (1, 0))
    i = torch.searchsorted(below, shares.contiguous(), right=True).clamp(1, weights.shape[-1])
    low, high = below.gather(-1, i - 1), below.gather(-1, i)
    share = ((shares - low) / (high - low).clamp_min(1e-12)).clamp(0, 1)
    return torch.lerp(edges.gather(-1, i - 1), edges.gather(-1, i), share)


def loops_fit(*tensors: Tensor) -> bool:
    """True for tensors supported by CPU loops: float32, without gradients."""
    wanted = torch.is_grad_enabled() and any(x.requires_grad for x in tensors)
    return not wanted and all(x.dtype == torch.float32 and not x.is_cuda for x in tensors)


def midpoints(x: Float[Tensor, "ray n"]) -> Float[Tensor, "ray n_less_one"]:
    return 0.5 * (x[:, 1:] + x[:, :-1])
