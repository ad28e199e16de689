"""Sparsity: what keeps density where photographs need some, and nowhere else."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def cauchy(density: Float[Tensor, " sample"], rays: int) -> Tensor:
    """Mean over rays of the sum of log(1 + 2 sigma^2) along each (Hedman 2021, section 4.2; Fridovich-Keil and Yu 2022,
    eq. 4)."""
    return torch.log1p(2 * density.square()).sum() / max(rays, 1)
