"""Reference implementation: all bins of all rays, (R, bins), then the inverse of each ray's distribution function."""

import torch
from torch import Tensor
from torch.nn.functional import pad

from ..contract.reference import run as contract
from ..dense_grid.reference import run as interpolated


@torch.no_grad()
def run(origins, directions, near, far, log_density, resampling, frustum) -> Tensor:
    bins, samples = resampling.bins, resampling.samples
    rays = origins, directions, near[:, None], far[:, None]
    t = distance(torch.arange(bins + 1, device=near.device).to(near) / bins, *rays, frustum)
    points = origins[:, None] + 0.5 * (t[:, 1:] + t[:, :-1])[..., None] * directions[:, None]
    coordinates, stretch = warp(points.view(-1, 3), frustum)
    values = interpolated(coordinates, log_density[..., None], coordinates.new_tensor([[-1.0] * 3, [1.0] * 3]))
    density = stretch * values[:, 0].clamp(max=resampling.max_log_density).exp()
    tau = density.view(-1, bins) * t.diff()

    weights = torch.exp(-pad(tau, (1, 0)).cumsum(1)[:, :-1]) * -torch.expm1(-tau)
    weights = weights**resampling.sharpness
    weights = weights + resampling.uniform_share / bins * weights.sum(1, keepdim=True) + resampling.min_weight
    below = pad(weights.cumsum(1), (1, 0)) / weights.sum(1, keepdim=True)

    share = (torch.arange(samples + 1, device=near.device).to(near) / samples).expand(len(t), -1).contiguous()
    i = torch.searchsorted(below, share, right=True).clamp(1, bins) - 1
    inside = ((share - below.gather(1, i)) / (below.gather(1, i + 1) - below.gather(1, i))).clamp(0, 1)
    return distance((i + inside) / bins, *rays, frustum)


def distance(share, origins, directions, near, far, frustum) -> Tensor:
    """Distances (R, share) at s between near (0) and far (1)."""
    if frustum is not None:
        first, last = ((origins[:, 2:] + t * directions[:, 2:]).clamp_min(frustum[2]) for t in (near, far))
        return near + (far - near) * (share * first / (share * first + (1 - share) * last))
    first, last = (torch.where(t < 1, t, 2 - 1 / t.clamp_min(1)) for t in (near, far))
    s = first + share * (last - first)
    return torch.where(s < 1, s, 1 / (2 - s).clamp_min(1e-6))


def warp(points: Tensor, frustum) -> tuple[Tensor, Tensor]:
    """Coordinates of points, and |det J|^(1/3) there."""
    if frustum is None:
        coordinates, stretch = contract(points, True)
        assert stretch is not None
        return coordinates, stretch
    scale_x, scale_y, plane = frustum
    x, y, z = points.unbind(1)
    z = z.clamp_min(plane)
    coordinates = torch.stack([scale_x * x / z, scale_y * y / z, 1 - 2 * plane / z], 1)
    return coordinates, (2 * scale_x * scale_y * plane) ** (1 / 3) * z ** (-4 / 3)
