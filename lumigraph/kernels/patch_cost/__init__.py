"""Photometric matching cost of slanted planes in neighbouring photographs, for PatchMatch stereo."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from .._operation import Facts, door, implementation, require, require_indices

FACTS = Facts(unit="pixels", unit_axes=2, outputs=1, differentiable=(), typical=2, compiled=2)

MIN_VARIANCE = 1e-5  # of values in [0, 1], added to a window's variance, so that flat windows agree with nothing
BEHIND_DEPTH = 1e-6  # third coordinate up to which a place is behind the neighbour


@door
def patch_cost(
    reference: Float[Tensor, "height width"],
    trust: Float[Tensor, "height width"],
    neighbours: Float[Tensor, "neighbour rows columns"],
    neighbour_trust: Float[Tensor, "neighbour rows columns"],
    warps: Float[Tensor, "neighbour 3 4"],
    pixels: Int64[Tensor, " pixel"],
    views: Int64[Tensor, "pixel view"],
    planes: Float[Tensor, "pixel plane 3"],
    radius: int = 2,
    deviation: float = 0.1,
) -> Float[Tensor, "pixel plane view"]:
    """Matching cost of each plane at a pixel in each of the pixel's views (Schönberger 2016, eq. 5; Xu & Tao 2019),
    from 0, the same, to 2.

    A plane (h, g, g') has the inverse depth h at its pixel, which changes by g per column and g' per row: inverse depth
    is affine in the picture. A warp (A | b) leads from a place (x, y) of the reference at the inverse depth H to

        (u, v, s) = A (x, y, 1) + H b,   seen at (u / s, v / s) if s > 0

    in a neighbour: the homography that the plane induces, for A = K' R K^-1, b = K' t; or a disparity in a rectified
    pair, for A = 1, b = (-1, 0, 0). There the neighbour is looked up between its four nearest pixels, b = (W b) / W, W
    its trust, zero outside. A window has (2 radius)^2 samples, at odd distances from its centre along both axes
    (`window`). Each has the bilateral weight

        w = trust exp(-(a - a0)^2 / (2 deviation^2) - r^2 / (2 R^2)),   W w in sums over both pictures

    a0 at the centre, r the distance from it and R = 2 radius. The result is one less the zero-mean normalised
    cross-correlation,

        cost = 1 - (sum W w / sum w) cov(a, b) / sqrt((var a + e) (var b + e))

    reference, neighbours: grey, about within [0, 1]; trust: from 0 to 1. A smaller neighbour is filled up with trust 0
    pixels: numbers of the reference's pixels, row by row; views: numbers of neighbours to look each up in
    radius: in steps of two pixels: 2 gives 16 samples, 7 pixels across
    Not differentiable.
    """
    require(radius > 0 and deviation > 0, f"a window of radius {radius} and deviation {deviation} cannot be")
    require_indices("pixels", pixels, reference.numel())
    require_indices("views", views, len(neighbours))
    run = implementation("patch_cost", reference)
    pictures = reference, trust, neighbours, neighbour_trust
    with torch.no_grad():
        return run(*pictures, warps, pixels, views, planes, window(radius), deviation)


def window(radius: int) -> list[tuple[int, int]]:
    """Offsets (dx, dy) of a window's samples."""
    odd = range(1 - 2 * radius, 2 * radius, 2)
    return [(dx, dy) for dy in odd for dx in odd]


def cases(generator: torch.Generator):
    """Test inputs for all engines: small and flat pictures, neighbours behind, masks, other sizes."""
    for size, its_size, count, pixels, planes, radius in [
        ((1, 1), (1, 1), 1, 1, 1, 1),
        ((3, 2), (5, 4), 2, 0, 3, 1),
        ((9, 14), (9, 14), 3, 40, 2, 2),
        ((13, 8), (7, 21), 2, 60, 1, 3),
        ((5, 37), (6, 33), 1, 50, 4, 2),
    ]:
        yield _inputs(size, its_size, count, pixels, planes, radius, generator)
    reference, trust, neighbours, its_trust, warps, *others = _inputs((9, 14), (8, 12), 2, 30, 2, 2, generator)
    everywhere, there = torch.ones_like(trust), torch.ones_like(its_trust)
    yield reference, everywhere, neighbours, there, warps, *others
    yield reference, everywhere, torch.full_like(neighbours, 0.25), there, warps, *others
    yield reference, 0 * trust, neighbours, its_trust, warps, *others
    yield reference, trust, neighbours, 0 * its_trust, warps, *others
    yield reference, trust, neighbours, its_trust, -warps, *others  # all of it lies behind
    far = warps.clone()
    far[0, 2, 3], far[1, :2, 3] = -2.5, 1e9  # some of it lies behind, or nowhere near the picture
    yield reference, everywhere, neighbours, there, far, *others


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """A square photograph of size / 8 pixels, three of six neighbours chosen, eight planes."""
    side = max(round((size / 8) ** 0.5), 1)
    inputs = [*_inputs((side, side), (side, side), 6, side * side, 8, 3, generator)]
    inputs[6] = inputs[6][:, :3].contiguous()
    return tuple(inputs)


def _inputs(size, its_size, count, pixels, planes, radius, generator):
    pictures = some_views(size, its_size, count, generator)
    chosen = torch.randperm(size[0] * size[1], generator=generator)[:pixels]
    varied = torch.rand(len(chosen), planes, 3, generator=generator)
    slanted = torch.tensor([0.3, -0.2, -0.2]) + torch.tensor([3.0, 0.4, 0.4]) * varied
    views = torch.rand(len(chosen), count, generator=generator).argsort(1)
    return *pictures, chosen, views, slanted, radius, 0.3


def some_views(size: tuple[int, int], its_size: tuple[int, int], count: int, generator: torch.Generator):
    """A smooth picture of varied brightness with its trust, slightly shifted neighbours with theirs, and the warps."""
    (height, width), (its_height, its_width) = size, its_size

    def wave(rows, columns, shift, phase):
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        return 0.5 + 0.2 * (0.9 * (x + shift) + 0.4 * y + phase).sin() + 0.2 * (0.3 * x - 0.7 * y - phase).cos()

    def uniform(*shape):
        return torch.rand(shape, generator=generator)

    phase = 6 * uniform(1)
    reference = wave(height, width, 0.0, phase)
    neighbours = torch.stack([wave(its_height, its_width, 1.0 + k, phase + 0.2 * k) for k in range(count)])
    trust = (1.3 * uniform(height, width)).clamp(max=1)
    its_trust = (1.3 * uniform(count, its_height, its_width)).clamp(max=1)
    trust[: height // 3, : width // 3] = 0
    its_trust[:, -1:, : its_width // 2] = 0
    warps = torch.eye(3, 4).repeat(count, 1, 1) + 0.02 * (uniform(count, 3, 4) - 0.5)
    warps[:, 2, :2] *= 0.1
    warps[:, :, 3] = torch.tensor([-1.0, 0.1, 0.01]) * (1 + uniform(count, 1))
    return reference, trust, neighbours, its_trust, warps
