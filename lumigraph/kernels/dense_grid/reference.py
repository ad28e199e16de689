"""The definition: what PyTorch has for it."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import grid_sample


def run(points: Tensor, grid: Tensor) -> Tensor:
    volume, places = grid.permute(3, 0, 1, 2)[None], 2 * points.flip(-1)[None, None, None] - 1
    return grid_sample(volume, places, padding_mode="border", align_corners=True)[0, :, 0, 0].t()
