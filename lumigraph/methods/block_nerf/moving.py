"""What moves, found by its residuals: parts of a photograph that no other agrees with teach nothing.

A field that many photographs share cannot show what stood before one of them, so that errors there stay large while all
others fall (as Sabour 2023 trims them). Rays are drawn at random over many photographs, so errors are remembered for
cells of each.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from ...method import Part

CELLS = 32  # along each side of a photograph
BEGINS, EVERY = 0.2, 100  # share of the budget before anything is judged, and steps between judgements
MEMORY = 0.7  # of a cell's error, that is kept when it is looked at again
STILL = 0.9  # share of cells that may always teach
MUCH = 2.5  # times the median error of its photograph, below which a cell teaches in any case


class Moving(Part):
    """Remembers how much each part of each photograph errs, and says which are to be learnt from.

    error: mean absolute error of each cell lately; 0 where nothing is known yet
    still: 1 for cells to learn from, else 0
    """

    error: Tensor
    still: Tensor

    def __init__(self, image_count: int):
        super().__init__()
        self.register_buffer("error", torch.zeros(image_count, CELLS, CELLS))
        self.register_buffer("still", torch.ones(image_count, CELLS, CELLS))

    def weights(self, image: Int[Tensor, " ray"], place: Float[Tensor, "ray 2"]) -> Float[Tensor, " ray"]:
        """1 for rays to learn from, else 0. place: on the picture, shares of its width and height"""
        return self.still.flatten()[cell_of(image, place)]

    @torch.no_grad()
    def note(self, image: Int[Tensor, " ray"], place: Float[Tensor, "ray 2"], error: Float[Tensor, " ray"]) -> None:
        """Remember the absolute errors of rays."""
        seen, which = cell_of(image, place).unique(return_inverse=True)
        total = torch.zeros(len(seen)).to(error).index_add_(0, which, error)
        mean = total / which.bincount(minlength=len(seen))
        before = self.error.view(-1)[seen]
        self.error.view(-1)[seen] = torch.where(before > 0, torch.lerp(mean, before, MEMORY), mean)

    @torch.no_grad()
    def judge(self) -> None:
        """Choose the cells to learn from: those that err, with their neighbours, no more than most, or not much more
        than others of their photograph."""
        known = self.error > 0
        if not known.any():
            return
        around = functional.avg_pool2d(self.error[:, None], 3, 1, 1)[:, 0]
        around = around / functional.avg_pool2d(known.float()[:, None], 3, 1, 1)[:, 0].clamp_min(1e-6)
        most = around[known].kthvalue(max(1, int(STILL * int(known.sum())))).values
        usual = torch.where(known, around, torch.nan).flatten(1).nanmedian(1).values[:, None, None]
        self.still.copy_((around <= most) | (around <= MUCH * usual) | ~known)

    def before_step(self, method: Any, step: int, progress: float) -> None:
        if progress >= BEGINS and step % EVERY == 0:
            self.judge()


def cell_of(image: Int[Tensor, " ray"], place: Float[Tensor, "ray 2"]) -> Int[Tensor, " ray"]:
    """The number of the cell, of all photographs' cells, that each ray passes."""
    column, row = (place * CELLS).long().clamp_(0, CELLS - 1).unbind(-1)
    return (image * CELLS + row) * CELLS + column
