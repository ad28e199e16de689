"""Reference implementation: every step of every ray, looked up and composited."""

import itertools

import torch
from torch import Tensor

from . import ALPHA, CHANNELS, Blocks

MIN_STRIDE_DIVISOR = 1e-3  # of a stride's divisor, beyond which there is nothing more


def run(
    origins: Tensor, directions: Tensor, enter: Tensor, leave: Tensor, blocks: Blocks, values: Tensor, stop: float
) -> tuple[Tensor, Tensor]:
    origins, directions, enter, leave = (x.detach() for x in (origins, directions, enter, leave))
    t = steps(origins, directions, enter, leave, blocks.ball)
    points = contracted(origins[:, None] + t[..., None] * directions[:, None], blocks.ball)
    v = looked_up(points.reshape(-1, 3), blocks, values).view(*t.shape, CHANNELS)
    v = v * (t < leave[:, None])[..., None]
    alpha = v[..., ALPHA]
    passed = torch.cat([torch.ones_like(enter)[:, None], 1 - alpha], -1).cumprod(-1)[:, :-1]
    transmittance = torch.where(passed < stop, 0, passed)
    return (transmittance[..., None] * v).sum(1), (transmittance * alpha * t).sum(1)


def steps(origins: Tensor, directions: Tensor, enter: Tensor, leave: Tensor, ball: float) -> Tensor:
    """Distance of each step (ray, step), padded to the longest ray."""
    if not ball:
        count = int((leave - enter).ceil().clamp_min(0).amax()) if len(enter) else 0
        return enter[:, None] + torch.arange(count, device=enter.device)
    first = origins - (2 * ball - 0.5)
    along = (first * directions).sum(-1)
    aside = (first - along[:, None] * directions).square().sum(-1)
    t, found = enter, [enter[:, None][:, :0]]
    while (t < leave).any():
        found.append(t[:, None])
        t = t + stride(along + t, aside, ball)
    return torch.cat(found, 1)


def stride(along: Tensor, aside: Tensor, ball: float) -> Tensor:
    """Distance along a ray to the next voxel. along: distance from the point closest to the ball's centre; aside: that
    point's squared distance from the centre"""
    radius = (aside + along.square()).sqrt()
    share = ball / radius.clamp_min(ball)
    speed = (1 + 4 * aside / ball**2 * (1 - share)).sqrt() * share * ball
    return torch.where(radius <= ball, 1, radius / (speed - along / radius).clamp_min(MIN_STRIDE_DIVISOR))


def contracted(points: Tensor, ball: float) -> Tensor:
    """Grid positions of points, contracted if there is a ball."""
    if not ball:
        return points
    middle = 2 * ball - 0.5
    share = ball / (points - middle).norm(dim=-1, keepdim=True).clamp_min(ball)
    return middle + (2 - share) * share * (points - middle)


def looked_up(points: Tensor, blocks: Blocks, values: Tensor) -> Tensor:
    """Trilinear interpolation of eight voxels, zero outside the grid and in empty blocks."""
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
