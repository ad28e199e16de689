"""Forward warping: soft splatting of points into a picture, and hole filling."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d

MAX_FOOTPRINT = 8  # pixels
HOLE_RADIUS = 8  # pixels around a place, of which the farther surfaces are background
BACKGROUND_SHARE = 0.95  # of the farthest distance there, from which on a surface is background


def soft_splat(
    places: Float[Tensor, "point 2"],
    values: Float[Tensor, "point channel"],
    importance: Float[Tensor, " point"],
    size: tuple[int, int],
    footprint: float,
) -> tuple[Float[Tensor, "height width channel"], Float[Tensor, "height width"]]:
    """Softmax splatting (Niklaus and Liu 2020, eq. 11): points add to the four pixels around them with weights

        w = b exp(Z),    value = sum w v / sum w

    with the bilinear b of each pixel and importance Z: of two points at one pixel the more important one dominates.
    Also returns sum b, the coverage. `importance` is first made relative to the largest around each pixel, so that exp
    neither overflows nor vanishes.
    footprint: pixels between neighbouring points, about; above one, points are enlarged to it
    """
    height, width = size
    reach = max(1, min(MAX_FOOTPRINT, math.ceil(footprint)))
    corner = (places - 0.5 * reach).floor().long()
    index, weights = [], []
    for dy in range(reach + 1):
        for dx in range(reach + 1):
            at = corner + torch.tensor([dx, dy], device=places.device)
            b = (1 - (at + 0.5 - places).abs() / reach).clamp_min(0).prod(-1)
            inside = ((at >= 0) & (at < torch.tensor([width, height], device=places.device))).all(-1)
            index.append(torch.where(inside, at[:, 1] * width + at[:, 0], height * width))
            weights.append(torch.where(inside, b, 0))
    pixel, b = torch.cat(index), torch.cat(weights)
    source = torch.arange(len(places), device=places.device).repeat(len(index))
    keep = b > 0
    pixel, b, source = pixel[keep], b[keep], source[keep]
    most = torch.full((height * width + 1,), -torch.inf, device=places.device)
    most = most.scatter_reduce(0, pixel, importance[source], "amax")
    w = b * torch.exp(importance[source] - most[pixel])
    channels = torch.cat([values, torch.ones_like(values[:, :1])], -1)
    total = channels.new_zeros(height * width + 1, channels.shape[1]).index_add(0, pixel, w[:, None] * channels[source])
    cover = b.new_zeros(height * width + 1).index_add(0, pixel, b)
    found = total[:-1, :-1] / total[:-1, -1:].clamp_min(1e-12)
    return found.view(height, width, -1), cover[:-1].view(height, width)


def pushed(
    values: Float[Tensor, "height width channel"], weight: Float[Tensor, "height width"]
) -> Float[Tensor, "height width channel"]:
    """Fill in values without a weight from coarser and coarser weighted means (pull-push, Gortler 1996, sec. 3.3)."""
    if (weight > 0).all():
        return values
    scale = weight.max().clamp_min(1e-12)
    pyramid = [torch.cat([values * weight[..., None], weight[..., None]], -1).movedim(-1, 0)[None] / scale]
    while max(pyramid[-1].shape[2:]) > 1:
        pyramid.append(avg_pool2d(pyramid[-1], 2, 2, ceil_mode=True))
    filled = pyramid[-1][:, :-1] / pyramid[-1][:, -1:].clamp_min(1e-12)
    for level in reversed(pyramid[:-1]):
        coarse = interpolate(filled, level.shape[2:], mode="bilinear")
        known = level[:, -1:] > 0
        filled = torch.where(known, level[:, :-1] / level[:, -1:].clamp_min(1e-12), coarse)
    return filled[0].movedim(0, -1)


def behind(
    values: Float[Tensor, "height width channel"],
    distance: Float[Tensor, "height width"],
    known: Bool[Tensor, "height width"],
) -> Float[Tensor, "height width channel"]:
    """Fill in unknown values from farther surfaces around them: disocclusions show background."""
    if known.all():
        return values
    farthest = max_pool2d((distance * known)[None], 2 * HOLE_RADIUS + 1, 1, HOLE_RADIUS)[0]
    weight = known * (distance > BACKGROUND_SHARE * farthest)
    return torch.where(known[..., None], values, pushed(values, weight.float()))
