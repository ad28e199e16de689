"""Robust mask: pixels with the largest residuals, of things that moved, are left out of the loss.

Trimmed least squares with smooth masks (Sabour et al. 2023, RobustNeRF, arXiv 2302.00833, section 4.2, eqs. 6 to 9).
Distractors cover patches of some photographs. Fine detail that is not learnt yet has large residuals at scattered
pixels, which go on counting.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from ...components.clouds.addition import Addition, Step

INLIER_SHARE = 0.8  # share of pixels below the threshold; the authors' release
HISTOGRAM_DECAY = 0.95  # factor for each step
BINS = 2000  # of residuals, in [0, 1]
SMOOTH_SHARE = 0.5  # share of inliers among the 3 x 3 pixels around one, eq. 7
PATCH_SIZE, NEIGHBOURHOOD_SIZE = 8, 16  # pixels along a side, eq. 8
PATCH_SHARE = 0.6  # share of inliers in a patch's neighbourhood, eq. 8
ROBUST_START = 0.1  # share of the budget before pixels are excluded


@dataclass(frozen=True)
class RobustNumbers:
    """A Config's numbers of the robust mask."""

    robust: Literal["auto", "yes", "no"] = "auto"  # exclude moving objects (RobustNeRF); auto: where colours differ


class RobustMask(Addition):
    """Inliers among the pixels of a photograph, by their residuals and those of the last steps.

    histogram: of recent residuals; a photograph counts as one
    """

    histogram: Tensor

    def __init__(self, numbers: RobustNumbers) -> None:
        super().__init__()
        self.numbers = numbers
        self.register_buffer("histogram", torch.zeros(BINS))

    def is_active(self, step: Step) -> bool:
        """True if pixels are left out: always, or with the setting auto where photographs differ."""
        return self.numbers.robust == "yes" or step.differ

    def mask(self, step: Step) -> None:
        if self.is_active(step) and step.progress >= ROBUST_START:
            counted = inliers(step.residual.abs().mean(-1), self.threshold)
            step.target = torch.where(counted[..., None], step.target, step.rgb.detach())

    def finish(self, step: Step) -> None:
        if self.is_active(step):
            self.record(step.residual.abs().mean(-1))

    @property
    def threshold(self) -> float:
        """Upper bound of the residuals of INLIER_SHARE of recent pixels; infinity before the first."""
        if not self.histogram.any():
            return torch.inf
        share = self.histogram.cumsum(0) / self.histogram.sum()
        return float(int((share < INLIER_SHARE).sum()) + 1) / BINS

    @torch.no_grad()
    def record(self, residual: Float[Tensor, "height width"]) -> None:
        """Add a photograph's residuals to the histogram, except zeros, which are pixels without content in either."""
        some = residual[residual > 0]
        self.histogram.mul_(HISTOGRAM_DECAY).add_(torch.histc(some, BINS, 0, 1) / max(len(some), 1))


@torch.no_grad()
def inliers(residual: Float[Tensor, "height width"], threshold: float) -> Bool[Tensor, "height width"]:
    """Pixels with a residual up to a threshold (eq. 6), or most of whose 3 x 3 neighbours have one (eq. 7), or in a
    patch of 8 x 8 most of whose neighbourhood of 16 x 16 has one (eqs. 8 and 9), joined as in the authors' code.

    Nothing beyond the picture is in a neighbourhood.
    """
    small = (residual <= threshold).float()[None, None]
    smooth = functional.avg_pool2d(small, 3, 1, 1, count_include_pad=False) >= SMOOTH_SHARE
    height, width = residual.shape
    rows, columns = -(-height // PATCH_SIZE), -(-width // PATCH_SIZE)
    beyond = (0, columns * PATCH_SIZE - width, 0, rows * PATCH_SIZE - height)  # the last patches may be cut
    inside = functional.pad(torch.ones_like(small), beyond)
    around = (NEIGHBOURHOOD_SIZE - PATCH_SIZE) // 2
    total, there = (
        functional.avg_pool2d(x, NEIGHBOURHOOD_SIZE, PATCH_SIZE, around, divisor_override=1)
        for x in (functional.pad(smooth.float(), beyond), inside)
    )
    patch = (total >= PATCH_SHARE * there).repeat_interleave(PATCH_SIZE, 2).repeat_interleave(PATCH_SIZE, 3)
    return ((small > 0) | smooth | patch[..., :height, :width])[0, 0]
