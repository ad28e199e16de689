"""Proposal sampling: intervals of each ray for the field, from a coarse density grid."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="rays", outputs=1, differentiable=(), typical=2, compiled=6)

MAX_BINS = 4096
Frustum = tuple[float, float, float]


@dataclass(frozen=True)
class Resampling:
    """Parameters of the inverse transform from the grid's weights to intervals.

    bins:            intervals of a ray at whose middles the grid is evaluated
    samples:         number of returned intervals
    sharpness:       exponent of the weights, from 0, which spreads samples evenly, to 1 (annealing)
    uniform_share:   share of the total weight that is spread evenly over the bins
    min_weight:      weight added to each bin, > 0
    max_log_density: upper limit of the grid's values
    """

    bins: int
    samples: int
    sharpness: float
    uniform_share: float
    min_weight: float
    max_log_density: float


@door
def sample_proposals(
    origins: Float[Tensor, "ray 3"],
    directions: Float[Tensor, "ray 3"],
    near: Float[Tensor, " ray"],
    far: Float[Tensor, " ray"],
    log_density: Float[Tensor, "x y z"],
    resampling: Resampling,
    frustum: Frustum | None = None,
) -> Float[Tensor, "ray edge"]:
    """Interval edges of a field's samples along each ray, by a proposal grid (Barron 2022, section 3.1).

    [near, far] is divided into bins of equal length in s. At the middle of bin i, of coordinates c_i, the grid gives

        tau_i = exp(log_density(c_i)) |det dc/dx|^(1/3) length_i,   w_i = exp(-sum_{j<i} tau_j) (1 - exp(-tau_i))

    and edge j of n lies where the distribution function of w^sharpness, linear in s, reaches j / n.

    log_density: per unit of coordinates, at corners that span [-1, 1] along each axis, two at least; interpolated
                 trilinearly and clamped at the faces
    near, far:   0 <= near <= far
    frustum:     None contracts (`contract`); s is distance up to one unit and disparity beyond. Else scale of x, scale
                 of y, and the near plane n of normalised device coordinates (Mildenhall 2020, appendix C): rays are in
                 that camera's frame, c = (scale_x x / z, scale_y y / z, 1 - 2 n / z) with z >= n, and s is even in 1/z
    Returns (R, samples + 1), from near to far. Not differentiable.
    """
    size, bins, samples = log_density.shape, resampling.bins, resampling.samples
    require(min(size) > 1 and log_density.numel() < 1 << 31, f"a grid of {tuple(size)} needs two corners on each axis")
    require(1 <= bins <= MAX_BINS and samples >= 1, f"{bins} bins and {samples} samples; bins go to {MAX_BINS}")
    possible = resampling.sharpness >= 0 and resampling.uniform_share >= 0 and resampling.min_weight > 0
    require(possible, f"{resampling} has a sharpness or weight that cannot be")
    require(frustum is None or min(frustum) > 0, f"the numbers of a frustum must be positive, not {frustum}")
    run = implementation("sample_proposals", origins)
    return run(origins, directions, near, far, log_density, resampling, frustum)


def cases(generator: torch.Generator):
    """Test inputs for all engines: one bin, more bins than samples and fewer, walls, rays that leave the
    frustum, rays of no length, more rays than a block."""
    for rays, size, bins, samples, sharpness, frustum in [
        (0, (2, 2, 2), 4, 2, 1.0, None),
        (1, (2, 3, 4), 1, 1, 1.0, None),
        (7, (9, 5, 7), 16, 8, 1.0, None),
        (4, (3, 3, 3), 5, 20, 0.0, None),
        (7, (6, 6, 6), 33, 20, 0.4, None),
        (7, (9, 5, 7), 16, 8, 1.0, (0.8, 1.1, 0.9)),
        (7, (5, 6, 3), 33, 20, 0.4, (1.5, 2.0, 0.5)),
    ]:
        yield _inputs(rays, size, bins, samples, sharpness, frustum, generator)
    for frustum in (None, (0.8, 1.1, 0.9)):
        *lines, grid, resampling, _ = _inputs(4, (8, 8, 8), 24, 12, 1.0, frustum, generator)
        wall = torch.where(torch.arange(8) < 6, -3.0, 40.0).expand(8, 8, 8)
        yield *lines, wall.contiguous(), resampling, frustum
    origins, directions, near, _, *rest = _inputs(3, (4, 4, 4), 8, 4, 1.0, (0.8, 1.1, 0.9), generator)
    yield origins, directions, 0 * near, 0 * near, *rest
    yield _inputs(65, (4, 5, 3), 6, 3, 1.0, None, generator)


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """Rays of 64 bins and 24 samples through a contracted grid of 96^3 corners; 32 times fewer than `size`."""
    return _inputs(size // 32, (96, 96, 96), 64, 24, 1.0, None, generator)


def _inputs(rays, size, bins, samples, sharpness, frustum, generator):
    """Rays from around the origin, towards +z in a frustum. Densities are smooth: with noise the comparison would only
    measure rounding of coordinates."""
    spread = torch.tensor([1.0, 1.0, 1.0] if frustum is None else [0.8, 0.4, 0.1])
    ahead = torch.tensor([0.0, 0.0, 0.0 if frustum is None else 1.0])
    origins = 0.3 * torch.randn(rays, 3, generator=generator)
    directions = torch.nn.functional.normalize(ahead + spread * torch.randn(rays, 3, generator=generator), dim=-1)
    near, far = (low + torch.rand(rays, generator=generator) for low in (0.1, 4.0))
    log_density = 1.5 * torch.randn(size, generator=generator)
    resampling = Resampling(bins, samples, sharpness, uniform_share=0.2, min_weight=1e-5, max_log_density=30.0)
    return origins, directions, near, far, log_density, resampling, frustum
