"""Reference implementation: rays laid out as rows, (R, K) with K the longest ray."""

import torch
from torch import Tensor


def run(tau: Tensor, values: Tensor, ray_starts: Tensor, stop: float) -> tuple[Tensor, Tensor, Tensor]:
    lengths = ray_starts.diff()
    longest = max(lengths.tolist(), default=0)
    inside = torch.arange(longest, device=tau.device) < lengths[:, None]

    tau = tau.new_zeros(inside.shape).masked_scatter(inside, tau)
    sum_tau = torch.nn.functional.pad(tau, (1, 0)).cumsum(1)[:, :-1]
    transmittance = torch.exp(-sum_tau)
    weights = transmittance * -torch.expm1(-tau)
    weights = torch.where(transmittance < stop, 0, weights)[inside]

    ray = torch.arange(len(lengths), device=tau.device).repeat_interleave(lengths)
    opacity = tau.new_zeros(len(lengths)).index_add(0, ray, weights)
    total = values.new_zeros(len(lengths), values.shape[1]).index_add(0, ray, weights[:, None] * values)
    return total, opacity, weights
