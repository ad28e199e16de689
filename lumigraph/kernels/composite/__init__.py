"""Compositing: samples along rays are accumulated to one value per ray."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .._operation import Facts, door, implementation, require_starts

FACTS = Facts(unit="samples", outputs=3, differentiable=(0, 1), typical=13, compiled=15, smooth=(15,))


@door
def composite(
    tau: Float[Tensor, " sample"],
    values: Float[Tensor, "sample channel"],
    ray_starts: Int[Tensor, " ray_plus_one"],
    stop: float = 0.0,
) -> tuple[Float[Tensor, "ray channel"], Float[Tensor, " ray"], Float[Tensor, " sample"]]:
    """Accumulate values front to back (Max 1995, eq. 9).

        T_i = exp(-sum_{j<i} tau_j)      transmittance in front of sample i
        w_i = T_i (1 - exp(-tau_i))      weight of sample i; 0 once T_i < stop

    tau:        optical thickness, density times length; never negative
    values:     colour, distance or anything else, per sample
    ray_starts: (R + 1,) int64; ray r owns samples ray_starts[r] to ray_starts[r + 1]
    stop:       early termination: samples behind this transmittance get weight 0 and no gradient

    Returns the accumulated values sum_i w_i v_i (R, C), opacity sum_i w_i (R,), and the weights (S,).
    All three are differentiable in tau and values.
    """
    require_starts("ray_starts", ray_starts, len(tau))
    return implementation("composite", tau)(tau, values, ray_starts, stop)


def cases(generator: torch.Generator):
    """Test inputs for all engines: empty space, haze and walls, with and without early termination."""
    for lengths in ([], [0], [1], [3, 0, 5], [0, 0, 63, 1, 0], [200, 1, 129]):
        for thickness, channels, stop in [(0.0, 1, 0.0), (0.1, 4, 0.0), (30.0, 3, 0.0), (0.2, 5, 0.05)]:
            yield _inputs(lengths, thickness, channels, stop, generator)
    tau, *rest = _inputs([40, 40], 0.1, 2, 0.0, generator)
    tau[30], tau[45] = 1e6, 1e6  # nothing is seen through these, and no digit lost in front of them
    yield tau, *rest


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """A training step's samples, about 32 to a ray, with colour and distance."""
    lengths = torch.randint(0, 64, (size // 32,), generator=generator).tolist()
    tau, values, ray_starts, stop = _inputs(lengths, 0.2, 4, 1e-4, generator)
    return tau.requires_grad_(), values.requires_grad_(), ray_starts, stop


def _inputs(lengths: list[int], thickness: float, channels: int, stop: float, generator: torch.Generator):
    ray_starts = torch.tensor([0, *lengths]).cumsum(0)
    tau = thickness * 2 * torch.rand(sum(lengths), generator=generator)
    if stop:  # sums of eighths are exact, so that no engine's rounding decides which side of `stop` a sample is on
        tau = (8 * tau).round() / 8
    return tau, torch.randn(sum(lengths), channels, generator=generator), ray_starts, stop
