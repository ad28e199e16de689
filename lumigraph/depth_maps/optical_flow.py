"""Optical flow: patches by inverse search from coarse to fine (Kroeger 2016, DIS), refined by a variational method
(Brox 2004)."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, interpolate, pad

from .. import kernels
from .flat_view import GREY

PATCH, STRIDE, SEARCHES = 8, 4, 20  # pixels a side and apart; iterations of a patch
MIN_SIDE = 12  # pixels along the shorter side of the coarsest pictures
OUTER, INNER, RELAXATION = 6, 6, 1.6  # linearisations of a level, steps of each, and their relaxation
SMOOTHNESS, GRADIENT_WEIGHT = 0.3, 0.25  # against brightness; of constant gradients
EDGE = 0.08  # of grey, over which smoothness falls to 1 / e
ROBUST = 1e-3  # of the square root that stands for an absolute value


@torch.no_grad()
def optical_flow(
    first: UInt8[Tensor, "height width 3"], second: UInt8[Tensor, "height width 3"]
) -> Float[Tensor, "height width 2"]:
    """Displacement (right, down) in pixels from each pixel of the first picture to the second one."""
    pyramids = [[x.float() @ torch.tensor(GREY) / 255] for x in (first, second)]
    while min(pyramids[0][-1].shape) >= 2 * MIN_SIDE:
        for pyramid in pyramids:
            pyramid.append(avg_pool2d(pyramid[-1][None, None], 2, ceil_mode=True)[0, 0])
    flow = torch.zeros(*pyramids[0][-1].shape, 2)
    for a, b in zip(*(reversed(pyramid) for pyramid in pyramids), strict=True):
        if flow.shape[:2] != a.shape:
            larger = 2 * interpolate(flow.movedim(-1, 0)[None], scale_factor=2.0, mode="bilinear")[0].movedim(0, -1)
            flow = larger[: a.shape[0], : a.shape[1]]
        flow = refined(searched(flow, a, b), a, b)
    return flow


def searched(
    flow: Float[Tensor, "height width 2"], a: Float[Tensor, "height width"], b: Float[Tensor, "height width"]
) -> Float[Tensor, "height width 2"]:
    """Flow of patches, blended at each pixel by how well they fit there (Kroeger 2016, eq. 5)."""
    height, width = a.shape
    rows, columns = (max(-(-(n - PATCH) // STRIDE), 0) + 1 for n in a.shape)
    middle = [
        (STRIDE * torch.arange(n) + PATCH // 2).clamp(max=side - 1) for n, side in ((rows, height), (columns, width))
    ]
    start = flow[middle[0]][:, middle[1]].contiguous()
    patches = kernels.patch_flow(start, a, b, gradient(a), PATCH, STRIDE, SEARCHES)
    total, weights = torch.zeros_like(flow), torch.zeros_like(a)
    for down in range(PATCH // STRIDE):
        for right in range(PATCH // STRIDE):
            row = (torch.arange(height) // STRIDE - down).clamp(0, rows - 1)
            column = (torch.arange(width) // STRIDE - right).clamp(0, columns - 1)
            one = patches[row][:, column]
            weight = 1 / (warped(b, one) - a).abs().clamp_min(1 / 255)
            total += weight[..., None] * one
            weights += weight
    return total / weights[..., None]


def refined(
    flow: Float[Tensor, "height width 2"], a: Float[Tensor, "height width"], b: Float[Tensor, "height width"]
) -> Float[Tensor, "height width 2"]:
    """Minimise sum psi(difference of brightness) + g psi(differences of gradients) + s psi(slope of the flow).

    psi(x^2) = sqrt(x^2 + e^2). Each step linearises the second picture about the flow, and weighs by psi' there.
    """
    of_a, of_b = gradient(a), gradient(b)
    across, down = (torch.exp(-x.abs() / EDGE) for x in (step(a, 1), step(a, 0)))
    for _ in range(OUTER):
        its = [warped(x, flow) for x in (b, *of_b.unbind(-1))]
        slopes = [0.5 * (gradient(x) + gradient(y)) for x, y in zip(its, (a, *of_a.unbind(-1)), strict=True)]
        differences = [x - y for x, y in zip(its, (a, *of_a.unbind(-1)), strict=True)]
        gradients = (differences[1] ** 2 + differences[2] ** 2 + ROBUST**2).rsqrt()
        weights = [(differences[0] ** 2 + ROBUST**2).rsqrt(), *2 * (GRADIENT_WEIGHT * gradients,)]
        data = torch.zeros(*a.shape, 5)
        for weight, slope, difference in zip(weights, slopes, differences, strict=True):
            x, y = slope.unbind(-1)
            rest = x * flow[..., 0] + y * flow[..., 1] - difference
            data += weight[..., None] * torch.stack([x * x, x * y, y * y, x * rest, y * rest], -1)
        steepness = torch.stack([step(flow[..., k], axis) ** 2 for k in (0, 1) for axis in (0, 1)]).sum(0)
        smooth = SMOOTHNESS * (steepness + ROBUST).rsqrt()
        flow = kernels.relax_flow(flow, data, smooth * across, smooth * down, INNER, RELAXATION)
    return flow


def step(values: Float[Tensor, "height width"], axis: int) -> Float[Tensor, "height width"]:
    """Difference to the next pixel; zero at the border."""
    return torch.diff(values, dim=axis, append=values.narrow(axis, values.shape[axis] - 1, 1))


def gradient(picture: Float[Tensor, "height width"]) -> Float[Tensor, "height width 2"]:
    """Central differences along x and y."""
    padded = pad(picture[None, None], (1, 1, 1, 1), "replicate")[0, 0]
    return torch.stack([padded[1:-1, 2:] - padded[1:-1, :-2], padded[2:, 1:-1] - padded[:-2, 1:-1]], -1) / 2


def warped(
    picture: Float[Tensor, "height width"], flow: Float[Tensor, "height width 2"]
) -> Float[Tensor, "height width"]:
    """The picture looked up at x + flow, so that it lies on the first one."""
    height, width = picture.shape
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    at = (torch.stack([x, y], -1) + flow) / torch.tensor([width, height]) * 2 - 1
    return grid_sample(picture[None, None], at[None], align_corners=False, padding_mode="border")[0, 0]
