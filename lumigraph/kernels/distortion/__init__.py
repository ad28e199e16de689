"""Distortion loss of the weights along each ray."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .._operation import Facts, door, implementation, require_starts

FACTS = Facts(unit="samples", outputs=1, differentiable=(0,), typical=5, compiled=5, smooth=(2, 3, 4))


@door
def distortion(
    weights: Float[Tensor, " sample"],
    middles: Float[Tensor, " sample"],
    lengths: Float[Tensor, " sample"],
    ray_starts: Int[Tensor, " ray_plus_one"],
) -> Float[Tensor, " ray"]:
    """Distortion loss of each ray, sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 d_i (Barron 2022, eq. 15), in linear
    time.

    It is least where a ray's weight is small or lies in one place: it removes fog before surfaces, and floaters.

    weights:    of samples, as `composite` gives them
    middles:    m, each sample's distance along its ray, in any unit; trusted to rise along each ray
    lengths:    d, in the same unit
    ray_starts: (R + 1,) int64; ray r owns samples ray_starts[r] to ray_starts[r + 1]

    Differentiable in weights. With W and M the sums of w_j and of w_j m_j over all j < i, and W' and M' those over all
    j > i, dL/dw_i = 2 (m_i (W - W') - (M - M')) + 2/3 w_i d_i.
    """
    require_starts("ray_starts", ray_starts, len(weights))
    return implementation("distortion", weights)(weights, middles, lengths, ray_starts)


def cases(generator: torch.Generator):
    """Test inputs for all engines: empty rays, one sample, more samples than a block holds."""
    for lengths in ([], [0], [1], [3, 0, 5], [0, 0, 63, 1, 0], [200, 1, 129]):
        yield _inputs(lengths, generator)


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """A training step's samples, about 32 to a ray."""
    weights, *rest = _inputs(torch.randint(0, 64, (size // 32,), generator=generator).tolist(), generator)
    return weights.requires_grad_(), *rest


def _inputs(counts: list[int], generator: torch.Generator):
    ray_starts = torch.tensor([0, *counts]).cumsum(0)
    ray = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts, dtype=torch.int64))
    number = torch.arange(len(ray)) - ray_starts[ray]
    middles = (number + torch.rand(len(ray), generator=generator)) / 256
    weights = torch.rand(len(ray), generator=generator) / torch.tensor(counts)[ray] if counts else torch.zeros(0)
    return weights, middles, torch.full_like(middles, 1 / 256), ray_starts
