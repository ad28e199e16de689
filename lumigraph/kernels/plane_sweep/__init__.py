"""Plane sweep: matching cost of a photograph with its neighbours at each depth hypothesis."""

import torch
from jaxtyping import Float
from torch import Tensor

from .._operation import Facts, door, implementation, require
from ..patch_cost import BEHIND_DEPTH as BEHIND_DEPTH
from ..patch_cost import some_views

FACTS = Facts(unit="pixels", unit_axes=2, outputs=1, differentiable=(), typical=2, compiled=2)

MIN_VARIANCE = 1e-4  # of values in [0, 1]: a hundredth, squared; windows with less are flat and agree with nothing


@door
def plane_sweep(
    reference: Float[Tensor, "height width"],
    trust: Float[Tensor, "height width"],
    neighbours: Float[Tensor, "neighbour rows columns"],
    neighbour_trust: Float[Tensor, "neighbour rows columns"],
    warps: Float[Tensor, "neighbour 3 4"],
    hypotheses: Float[Tensor, " plane"],
    window: int = 5,
    best: int = 1,
) -> Float[Tensor, "plane height width"]:
    """The matching cost of every hypothesis at every pixel (Collins 1996; Gallup 2007), from 0, the same, to 2.

    A warp (A | b) and a hypothesis h lead from a pixel's centre (x, y) of the reference to its place in a neighbour,

        (u, v, s) = A (x, y, 1) + h b,   seen at (u / s, v / s) if s > 0

    so h is inverse depth for A = K' R K^-1, b = K' t, or disparity in a rectified pair for A = 1, b = (-1, 0, 0).
    There the neighbour is looked up between its four nearest pixels: b = (W b) / W, W its trust, zero outside. Over a
    window of pixels, each with weight w = trust W, of which it holds n = sum w,

        cost = 1 - n / window^2 cov(a, b) / sqrt((var a + e) (var b + e))

    is one less the zero-mean normalised cross-correlation: blind to brightness and contrast, and 1 where nothing is
    seen. Of all neighbours' costs the mean of the `best` least is returned, since others may be hidden (Kang 2001).

    reference, neighbours: grey, about within [0, 1]; trust: from 0 to 1. A smaller neighbour is filled up with trust 0
    window: pixels along a side, an odd number; best: from 1 to the number of neighbours
    Not differentiable.
    """
    possible = window > 0 and window % 2 == 1 and 1 <= best <= len(neighbours)
    require(possible, f"a window of {window} and the best {best} of {len(neighbours)} neighbours cannot be")
    run = implementation("plane_sweep", reference)
    with torch.no_grad():  # the same without their means, so that sums of squares stay small
        reference = centred(reference[None], trust[None])[0]
        neighbours = centred(neighbours, neighbour_trust)
        return run(reference, trust, neighbours, neighbour_trust, warps, hypotheses, window, best)


def centred(pictures: Float[Tensor, "picture rows columns"], trust: Float[Tensor, "picture rows columns"]) -> Tensor:
    """Pictures less their trust-weighted mean, zero where trust is zero."""
    total = trust.sum((1, 2), keepdim=True).clamp_min(1e-6)
    mean = (pictures * trust).sum((1, 2), keepdim=True) / total
    return torch.where(trust > 0, pictures - mean, 0)


def cases(generator: torch.Generator):
    """Test inputs for all engines: small and flat pictures, neighbours behind, masks, other sizes."""
    for size, its_size, count, planes, window, best in [
        ((1, 1), (1, 1), 1, 1, 1, 1),
        ((3, 2), (5, 4), 2, 0, 3, 1),
        ((9, 14), (9, 14), 3, 2, 5, 2),
        ((13, 8), (7, 21), 2, 1, 7, 2),
        ((5, 37), (6, 33), 1, 2, 3, 1),
    ]:
        yield _inputs(size, its_size, count, planes, window, best, generator)
    reference, trust, neighbours, its_trust, warps, hypotheses, window, best = _inputs(
        (9, 14), (8, 12), 2, 2, 3, 1, generator
    )
    everywhere, there = torch.ones_like(trust), torch.ones_like(its_trust)
    yield reference, everywhere, torch.full_like(neighbours, 0.25), there, warps, hypotheses, window, best
    yield reference, 0 * trust, neighbours, its_trust, warps, hypotheses, window, best
    yield reference, trust, neighbours, 0 * its_trust, warps, hypotheses, window, best
    yield reference, trust, neighbours, its_trust, -warps, hypotheses, window, best  # all of it lies behind
    reference, trust, neighbours, its_trust, warps, hypotheses, *_ = _inputs((4, 6), (5, 4), 2, 2, 3, 1, generator)
    everywhere, there, far = torch.ones_like(trust), torch.ones_like(its_trust), warps.clone()
    far[0, 2, 3], far[1, :2, 3] = -2.5, 1e9  # some of it lies behind, or nowhere near the picture
    yield reference, everywhere, neighbours, there, far, hypotheses, window, 2


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """A square photograph of size / 8 pixels, four neighbours, 32 planes."""
    side = max(round((size / 8) ** 0.5), 1)
    return _inputs((side, side), (side, side), 4, 32, 5, 2, generator)


def _inputs(size, its_size, count, planes, window, best, generator):
    pictures = some_views(size, its_size, count, generator)
    return *pictures, 0.3 + 3 * torch.rand(planes, generator=generator), window, best
