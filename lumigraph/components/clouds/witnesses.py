"""Witnesses of a Gaussian: in how many photographs something of it was seen while it was learnt."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

MARKS = 62  # bits of a row; a photograph more shares one, so that they are never too many
ALL = (1 << MARKS) - 1
FEWEST = {1: 3, 4: 6}  # coefficient of the harmonics, and how many must have seen a Gaussian for it and those beyond


def marked(
    marks: Int[Tensor, " gaussian"], image_index: int, seen: Bool[Tensor, " gaussian"]
) -> Int[Tensor, " gaussian"]:
    """Marks with one photograph's added, where it saw a Gaussian. A row is a set: a bit for each photograph."""
    return marks | seen.long() << image_index % MARKS


def witnesses(marks: Int[Tensor, " gaussian"]) -> Int[Tensor, " gaussian"]:
    """How many bits are set: of 2, then 4, then 8 neighbours at once, and these summed by a multiplication."""
    pairs = marks - (marks >> 1 & 0x5555555555555555)
    fours = (pairs & 0x3333333333333333) + (pairs >> 2 & 0x3333333333333333)
    eights = fours + (fours >> 4) & 0x0F0F0F0F0F0F0F0F
    return eights * 0x0101010101010101 >> 56


@torch.no_grad()
def hold_back(harmonics: Float[Tensor, "gaussian coefficient 3"], seen_by: Int[Tensor, " gaussian"]) -> None:
    """Set to zero, in place, what of the harmonics a Gaussian's witnesses are too few for: a colour that changes with
    the direction is told by several directions, and from elsewhere may be anything."""
    for first, fewest in FEWEST.items():
        few = (seen_by < fewest).nonzero()[:, 0]
        harmonics[few, first:] = 0
