"""Marching through a forward-facing capture: even steps in normalised device coordinates, where rays stay straight."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ...rays import Rays, Samples
from .occupancy import OccupancyGrid
from .spaces import NDC

ELSEWHERE = 2.0  # a coordinate outside of every grid, from where a ray that sees nothing goes on outwards


@torch.no_grad()
def march_forward(
    space: NDC, occupancy: OccupancyGrid, rays: Rays, step: float, jitter: Float[Tensor, " ray"] | None = None
) -> Samples:
    """Samples in occupied cells of a grid over coordinates, from the near plane to nearly infinity; their distances are
    the scene's.

    step:   in coordinates
    jitter: in [0, 1), moves each ray's lattice by that share of a step
    """
    near, far = space.interval(rays)
    first, last = (space.warp(rays.at(t)) for t in (near, far))
    length = (last - first).norm(dim=-1)
    sees = length > 0
    out = torch.tensor([1.0, 0.0, 0.0], device=length.device)
    straight = Rays(
        torch.where(sees[:, None], first, ELSEWHERE),
        torch.where(sees[:, None], (last - first) / length.clamp_min(1e-9)[:, None], out),
        rays.radius,
    )
    found = occupancy.sample(straight, 0.0, step, jitter=jitter)
    ray = found.ray_index
    ends = torch.stack([found.t_start, found.t_end], 1) / length[ray].clamp_min(1e-9)[:, None]
    start, end = space.distance(ends.clamp(0, 1), rays[ray], near[ray], far[ray]).unbind(1)
    return Samples(start.contiguous(), end.contiguous(), found.ray_starts)
