"""Reference implementation: every lattice interval of every ray, (R, K), then a mask."""

import torch
from torch import Tensor


@torch.no_grad()
def run(origins, directions, t_near, t_far, occupied, density, step, growth, stop) -> tuple[Tensor, Tensor, Tensor]:
    t_far = torch.minimum(t_far, _beyond_all(origins, len(occupied)))
    t = lattice(t_near, t_far, step, growth)
    t_start, t_end = t[:, :-1], t[:, 1:]
    middle = 0.5 * (t_start + t_end)

    cell, held = locate(origins[:, None] + middle[..., None] * directions[:, None], occupied.shape)
    kept = held & occupied[cell] & (middle < t_far[:, None])
    thickness = torch.where(kept, density[cell] * (t_end - t_start), 0)
    before = torch.nn.functional.pad(thickness, (1, 0)).cumsum(1)[:, :-1]
    kept &= torch.exp(-before) >= stop

    ray_starts = torch.nn.functional.pad(kept.sum(1).cumsum(0), (1, 0))
    return t_start[kept], t_end[kept], ray_starts


def lattice(t_near: Tensor, t_far: Tensor, step: float, growth: float) -> Tensor:
    """(R, K + 1) interval ends from t_near until all rays have passed t_far: t_{k+1} = t_k + max(step, growth t_k)."""
    t = [t_near]
    while (t[-1] < t_far).any() or len(t) < 2:
        t.append(t[-1] + (growth * t[-1]).clamp(min=step))
    return torch.stack(t, 1)


def locate(x: Tensor, shape: tuple[int, ...]) -> tuple[tuple[Tensor, ...], Tensor]:
    """Index [cascade, x, y, z] of each point's cell, and a mask of points inside a cascade."""
    cascades, n = shape[:2]
    distance = x.abs().amax(-1)
    cascade = (distance[..., None] >= 2.0 ** torch.arange(cascades, device=x.device)).sum(-1)
    held = cascade < cascades
    cascade = cascade.clamp(max=cascades - 1)
    cell = ((x / 2.0 ** cascade[..., None] + 1) / 2 * n).long().clamp(0, n - 1)
    return (cascade, *cell.unbind(-1)), held


def _beyond_all(origins: Tensor, cascades: int) -> Tensor:
    """A distance at which each ray has left the last cascade."""
    return origins.norm(dim=-1) + 3**0.5 * 2.0 ** (cascades - 1)
