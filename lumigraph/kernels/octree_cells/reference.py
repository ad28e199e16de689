"""Reference implementation: all rays step in lockstep, each from its cell to the next."""

import math

import torch
from torch import Tensor

from . import MIN_SPEED, Tree


@torch.no_grad()
def run(
    origins: Tensor, directions: Tensor, tree: Tree, density: Tensor, near: float, stop: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    side, rays = 1 << tree.depth, torch.arange(len(origins), device=origins.device)
    inverse = 1 / torch.where(directions.abs() < MIN_SPEED, MIN_SPEED, directions)
    a, b = -origins * inverse, (1 - origins) * inverse
    t, far = torch.minimum(a, b).amax(-1).clamp_min(near), torch.maximum(a, b).amin(-1)
    place = ((origins + t[:, None] * directions) * side).floor().nan_to_num().clamp(0, side - 1).long()
    thickness, most = torch.zeros_like(t), -math.log(stop) if stop else math.inf
    named, found = tree.named.long(), []
    alive = t < far
    while alive.any():
        rays, origins, directions, inverse = rays[alive], origins[alive], directions[alive], inverse[alive]
        t, place, thickness = t[alive], place[alive], thickness[alive]
        value, size = leaves(tree, place)
        low = place // size[:, None] * size[:, None]
        face = low + torch.where(inverse > 0, size[:, None], 0)
        leave = (face / side - origins) * inverse
        end = torch.maximum(leave.amin(-1), t)
        row = torch.full_like(value, -1)
        row[value < 0] = named[-1 - value[value < 0]]
        found.append((rays[row >= 0], t[row >= 0], end[row >= 0], row[row >= 0]))
        thickness = thickness + torch.where(row >= 0, density[row.clamp_min(0)] if len(density) else 0, 0) * (end - t)
        within = ((origins + end[:, None] * directions) * side).floor().long()
        within = torch.minimum(torch.maximum(within, low), low + size[:, None] - 1)
        through = torch.nn.functional.one_hot(leave.argmin(-1), 3).bool()
        place = torch.where(through, torch.where(inverse > 0, face, low - 1), within)
        t, alive = end, ((place >= 0) & (place < side)).all(-1) & (thickness <= most)
    if not found:
        return t[:0], t[:0], torch.zeros(len(rays) + 1, dtype=torch.int64, device=t.device), rays[:0]
    ray, begin, end, row = (torch.cat(parts) for parts in zip(*found, strict=True))
    order, counts = ray.argsort(stable=True), torch.bincount(ray, minlength=len(a))
    return begin[order], end[order], torch.nn.functional.pad(counts.cumsum(0), (1, 0)), row[order]


def leaves(tree: Tree, place: Tensor) -> tuple[Tensor, Tensor]:
    """Entries of `Tree.cells` for the leaf cells at places (x, y, z), whole numbers below 2^depth along each
    axis; and the cells' sides, in the same unit."""
    cells = tree.cells.flatten().long()
    node, size = torch.zeros_like(place[:, 0]), torch.full_like(place[:, 0], 1 << tree.depth)
    value = node
    divided = torch.ones_like(node, dtype=torch.bool)
    for level in range(tree.depth):
        x, y, z = (place >> (tree.depth - 1 - level) & 1).unbind(-1)
        value = torch.where(divided, cells[8 * node + 4 * x + 2 * y + z], value)
        size = torch.where(divided, size >> 1, size)
        divided = divided & (value > 0)
        node = torch.where(divided, value, node)
    return value, size
