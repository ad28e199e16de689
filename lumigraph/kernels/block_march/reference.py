"""The definition: every step of every ray, looked up and composited."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from . import ALPHA, CHANNELS, Blocks


def run(
    origins: Tensor, directions: Tensor, enter: Tensor, leave: Tensor, blocks: Blocks, values: Tensor, stop: float
) -> tuple[Tensor, Tensor]:
    origins, directions, enter, leave = (x.detach() for x in (origins, directions, enter, leave))
    rays = len(origins)
    steps = torch.arange(int((leave - enter).ceil().clamp_min(0).amax()) if rays else 0, device=origins.device)
    t = enter[:, None] + steps
    points = origins[:, None] + t[..., None] * directions[:, None]
    seen = looked_up(points.reshape(-1, 3), blocks, values).view(rays, len(steps), CHANNELS)
    seen = seen * (t < leave[:, None])[..., None]
    alpha = seen[..., ALPHA]
    passed = torch.cat([torch.ones_like(enter)[:, None], 1 - alpha], -1).cumprod(-1)[:, :-1]
    light = torch.where(passed < stop, 0, passed)
    return (light[..., None] * seen).sum(1), (light * alpha * t).sum(1)


def looked_up(points: Tensor, blocks: Blocks, values: Tensor) -> Tensor:
    """Eight voxels, blended; all that lies beyond the grid or in a block that is left out is empty."""
    block, size = blocks.block, torch.tensor(blocks.index.shape, device=points.device)
    own = ((points + 0.5) / block).floor().long()
    inside = ((own >= 0) & (own < size)).all(-1)
    x, y, z = torch.where(inside[:, None], own, 0).unbind(-1)
    number = torch.where(inside, blocks.index[x, y, z], -1).long()
    place = points - block * own + 1
    corner = place.floor().long().clamp(0, block)
    fraction = place - corner
    table = torch.cat([values, values.new_zeros(1, CHANNELS)])
    total = values.new_zeros(len(points), CHANNELS)
    for side in itertools.product((0, 1), repeat=3):
        at = torch.tensor(side, device=points.device)
        weight = torch.where(at == 1, fraction, 1 - fraction).prod(-1)
        rows = torch.full_like(number, -1)
        there = (number >= 0).nonzero()[:, 0]
        x, y, z = (corner[there] + at).unbind(-1)
        rows[there] = blocks.rows[number[there], x, y, z].long()
        total = total + weight[:, None] * table[rows.clamp_min(-1)]
    return total
