"""View count of a Gaussian: the number of photographs in which it was visible during training."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

VIEW_BITS = 62  # bits of a row; further photographs share them, which may only lower the count
MIN_VIEWS = {1: 3, 4: 6}  # index of a coefficient, and the view count from which it and those beyond are learnt


def with_view(
    bits: Int[Tensor, " gaussian"], image_index: Int[Tensor, " 1"], visible: Bool[Tensor, " gaussian"]
) -> Int[Tensor, " gaussian"]:
    """View bits with those of one photograph. A row is a set: a bit for each photograph."""
    return bits | visible.long() << image_index % VIEW_BITS


def view_count(bits: Int[Tensor, " gaussian"]) -> Int[Tensor, " gaussian"]:
    """Number of bits that are set: of 2, then 4, then 8 neighbours at once, and these summed by a multiplication."""
    pairs = bits - (bits >> 1 & 0x5555555555555555)
    fours = (pairs & 0x3333333333333333) + (pairs >> 2 & 0x3333333333333333)
    eights = fours + (fours >> 4) & 0x0F0F0F0F0F0F0F0F
    return eights * 0x0101010101010101 >> 56


@torch.no_grad()
def zero_unobserved_sh(harmonics: Float[Tensor, "gaussian coefficient 3"], count: Int[Tensor, " gaussian"]) -> None:
    """Set harmonics to zero, in place, for which a Gaussian's view count is too low: view dependence that few
    directions determine may be anything from elsewhere."""
    for first, fewest in MIN_VIEWS.items():
        few = (count < fewest).nonzero()[:, 0]
        harmonics[few, first:] = 0
