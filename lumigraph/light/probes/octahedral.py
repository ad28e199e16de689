"""Octahedral maps (Cigolle 2014): the sphere on a square, with a border for interpolation across its edges."""

import torch
from jaxtyping import Float
from torch import Tensor

BORDER = 1  # texels around a map, copies of those that neighbour across its edges


def encoded(directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
    """Octahedral coordinates in [-1, 1]^2: (x, y) / (|x| + |y| + |z|), with the lower half folded outward."""
    x, y, z = (directions / directions.abs().sum(-1, keepdim=True)).unbind(-1)
    sign_x, sign_y = (torch.where(v >= 0, 1.0, -1.0) for v in (x, y))
    below = z < 0
    across = torch.where(below, (1 - y.abs()) * sign_x, x)
    return torch.stack([across, torch.where(below, (1 - x.abs()) * sign_y, y)], -1)


def decoded(places: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
    """Unit directions of octahedral coordinates in [-1, 1]^2."""
    x, y = places.unbind(-1)
    z = 1 - x.abs() - y.abs()
    fold = (-z).clamp_min(0)
    x, y = (v - fold * torch.where(v >= 0, 1.0, -1.0) for v in (x, y))
    return torch.nn.functional.normalize(torch.stack([x, y, z], -1), dim=-1)


def texel_directions(side: int) -> Float[Tensor, "texel 3"]:
    """Directions of the centres of side x side texels, row by row; y grows downwards with the row."""
    share = (torch.arange(side) + 0.5) / side * 2 - 1
    y, x = torch.meshgrid(share, share, indexing="ij")
    return decoded(torch.stack([x, y], -1).reshape(-1, 2))


def bordered(maps: Float[Tensor, "map side side"]) -> Float[Tensor, "map wide wide"]:
    """Maps with a border of one texel, so that bilinear interpolation is continuous over the sphere."""
    top, bottom = maps[:, :1].flip(-1), maps[:, -1:].flip(-1)
    tall = torch.cat([top, maps, bottom], 1)
    left, right = maps[:, :, :1].flip(1), maps[:, :, -1:].flip(1)
    corners = maps[:, -1:, -1:], maps[:, :1, -1:], maps[:, -1:, :1], maps[:, :1, :1]
    left = torch.cat([corners[0], left, corners[1]], 1)
    right = torch.cat([corners[2], right, corners[3]], 1)
    return torch.cat([left, tall, right], 2)


def looked_up(
    maps: Float[Tensor, "map wide wide"], number: Tensor, directions: Float[Tensor, "row 3"]
) -> Float[Tensor, " row"]:
    """Bilinear values of bordered maps. number: the map of each row"""
    side = maps.shape[1] - 2 * BORDER
    place = (encoded(directions) + 1) / 2 * side + BORDER - 0.5
    first = place.floor().clamp(0, side)
    (fx, fy), (x, y) = (place - first).unbind(-1), first.long().unbind(-1)
    upper = maps[number, y, x] * (1 - fx) + maps[number, y, x + 1] * fx
    lower = maps[number, y + 1, x] * (1 - fx) + maps[number, y + 1, x + 1] * fx
    return upper * (1 - fy) + lower * fy
