"""Coarse to fine: bands of an encoding join one after another, so that poses are found before details mislead them."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

FIRST = 1 / 4  # share of the bands that are there from the beginning
BEGINS, ENDS = 0.05, 0.4  # shares of the budget between which the others join


def band_weights(count: int, progress: float, begins: float = BEGINS, ends: float = ENDS) -> Float[Tensor, " band"]:
    """Weights in [0, 1] of an encoding's bands, the coarsest first (Lin 2021, BARF, eq. 14).

        w_k = 0 for alpha < k,  (1 - cos((alpha - k) pi)) / 2 for alpha - k in [0, 1),  1 beyond

    count:    of bands: octaves of waves, levels of a hash table
    progress: share of the budget that is spent; alpha grows evenly with it, from FIRST of the bands to all of them,
              between the shares `begins` and `ends`
    """
    grown = min(max((progress - begins) / (ends - begins), 0.0), 1.0)
    first = max(1.0, FIRST * count)
    alpha = first + grown * (count - first)
    return (1 - torch.cos(math.pi * (alpha - torch.arange(count)).clamp(0, 1))) / 2
