"""Reference implementation: PyTorch's own interpolation of planes and lines, as the paper's code composes it."""

from functools import reduce
from operator import mul

import torch
from torch import Tensor
from torch.nn import functional as F

from . import MODES, Factors


def run(points: Tensor, table: Tensor, factors: Factors, summed: bool) -> Tensor:
    places, parts = 2 * points.detach() - 1, factors.split(table)
    lines = [_line(part, places[:, axis]) for axis, part in enumerate(parts[-3:])]
    if factors.kind == "vm":
        planes = [_plane(part, places[:, [b, a]]) for part, (a, b, _) in zip(parts, MODES, strict=False)]
        found = torch.cat([plane * lines[beside] for plane, (_, _, beside) in zip(planes, MODES, strict=True)], 1)
    else:
        found = reduce(mul, lines)
    return found.sum(1, keepdim=True) if summed else found


def _plane(nodes: Tensor, places: Tensor) -> Tensor:
    """Bilinear interpolation of nodes (a, b, component) at coordinates (sample, 2), whose first is along b."""
    picture, at = nodes.permute(2, 0, 1)[None], places[None, None]
    return F.grid_sample(picture, at, padding_mode="border", align_corners=True)[0, :, 0].t()


def _line(nodes: Tensor, places: Tensor) -> Tensor:
    """Linear interpolation of nodes (n, component) at places (sample): a picture one column wide."""
    return _plane(nodes[:, None], torch.stack([torch.zeros_like(places), places], -1))
