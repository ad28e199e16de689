"""Trimming: pixels whose error is among the largest teach nothing, for something passed before them.

Trimmed least squares with smooth masks (Sabour et al. 2023, RobustNeRF, arXiv 2302.00833, section 4.2, eqs. 6 to 9).
What passes covers patches of some photographs; fine detail that is not learnt yet errs at scattered pixels, and goes on
counting.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

KEPT = 0.8  # of all pixels err little enough, by which the threshold goes; the authors' release
DECAY = 0.95  # of the counts of errors, a step
BINS = 2000  # of errors, in [0, 1]
SMOOTH = 0.5  # share of the 3 x 3 pixels around one that must err little, eq. 7
INNER, OUTER = 8, 16  # sides of a patch and of its neighbourhood, eq. 8
PATCH = 0.6  # share of the neighbourhood that must err little, eq. 8


class Trimming(nn.Module):
    """Says which pixels of a photograph to learn from, by their errors and how large those of the last steps were.

    counts: of errors lately, by size; a photograph counts as one
    """

    counts: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("counts", torch.zeros(BINS))

    @property
    def threshold(self) -> float:
        """The error that KEPT of all pixels had at most, lately; infinity where nothing is known."""
        if not self.counts.any():
            return torch.inf
        share = self.counts.cumsum(0) / self.counts.sum()
        return float(int((share < KEPT).sum()) + 1) / BINS

    @torch.no_grad()
    def note(self, error: Float[Tensor, "height width"]) -> None:
        """Add a photograph's errors to the counts. Where there is none at all, nothing was photographed nor is
        it rendered, and such pixels say nothing of how well others are learnt."""
        some = error[error > 0]
        self.counts.mul_(DECAY).add_(torch.histc(some, BINS, 0, 1) / max(len(some), 1))

    def forward(self, error: Float[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
        """Which pixels count; all of them until `note` was told of some."""
        return inliers(error, self.threshold)


@torch.no_grad()
def inliers(error: Float[Tensor, "height width"], threshold: float) -> Bool[Tensor, "height width"]:
    """Pixels that err by no more than a threshold (eq. 6), or whose 3 x 3 neighbours do so for the most part (eq. 7),
    or that lie in a patch of 8 x 8 whose neighbourhood of 16 x 16 does (eqs. 8 and 9), joined as in the authors' code.

    What lies beyond the picture is in no neighbourhood.
    """
    small = (error <= threshold).float()[None, None]
    smooth = functional.avg_pool2d(small, 3, 1, 1, count_include_pad=False) >= SMOOTH
    height, width = error.shape
    rows, columns = -(-height // INNER), -(-width // INNER)
    beyond = (0, columns * INNER - width, 0, rows * INNER - height)  # the last patches may be cut
    inside = functional.pad(torch.ones_like(small), beyond)
    around = (OUTER - INNER) // 2
    total, there = (
        functional.avg_pool2d(x, OUTER, INNER, around, divisor_override=1)
        for x in (functional.pad(smooth.float(), beyond), inside)
    )
    patch = (total >= PATCH * there).repeat_interleave(INNER, 2).repeat_interleave(INNER, 3)
    return ((small > 0) | smooth | patch[..., :height, :width])[0, 0]
