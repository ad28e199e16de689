"""Reference implementation in PyTorch."""

import torch

from ..block_hash import SIDE
from ..block_hash.reference import find
from . import case_table


def lattice(count, device):
    """Indices (i, j, k) from 0 to count - 1 along each axis, k fastest."""
    axis = torch.arange(count, device=device)
    return torch.cartesian_prod(axis, axis, axis)


def run(voxels, blocks, table, min_weight):
    device, channels = voxels.device, voxels.shape[2]
    neighbours = find(blocks[:, None] + lattice(2, device).int(), blocks, table)
    places = lattice(SIDE + 1, device)
    block, voxel = places // SIDE, places % SIDE
    number = neighbours[:, (block * torch.tensor([4, 2, 1], device=device)).sum(-1)]
    rows = (voxel * torch.tensor([SIDE * SIDE, SIDE, 1], device=device)).sum(-1)
    if not len(blocks):
        return voxels.new_zeros(0, 3), voxels.new_zeros(0, channels - 2), number.new_zeros(0, 3)
    values = voxels[number.clamp_min(0), rows]
    size = SIDE + 1
    values = values.view(-1, size, size, size, channels)
    known = (number >= 0).view(-1, size, size, size) & (values[..., 1] > min_weight)
    negative = values[..., 0] < 0

    def take_neighbours(x, step):
        """Neighbour of each voxel of the blocks, a step away."""
        i, j, k = step
        return x[:, i : i + SIDE, j : j + SIDE, k : k + SIDE]

    here, axes = (0, 0, 0), ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    crossed = torch.stack(
        [
            take_neighbours(known, here)
            & take_neighbours(known, a)
            & (take_neighbours(negative, here) != take_neighbours(negative, a))
            for a in axes
        ],
        -1,
    )
    index = (crossed.flatten().cumsum(0) - 1).view(crossed.shape)
    b, i, j, k, axis = crossed.nonzero().unbind(-1)
    step = torch.eye(3, dtype=torch.int64, device=device)[axis]
    one, other = values[b, i, j, k], values[b, i + step[:, 0], j + step[:, 1], k + step[:, 2]]
    share = (one[:, 0] / (one[:, 0] - other[:, 0]))[:, None]
    places = SIDE * blocks[b] + torch.stack([i, j, k], -1)
    vertices = places.to(values) + share * step
    if channels > 2:
        share = torch.where(one[:, 2:3] < 0, 1.0, torch.where(other[:, 2:3] < 0, 0.0, share))
    mixed = one[:, 2:] + share * (other[:, 2:] - one[:, 2:])

    corners = torch.stack([take_neighbours(negative, (c >> 2, c >> 1 & 1, c & 1)) for c in range(8)], -1)
    whole = torch.stack([take_neighbours(known, (c >> 2, c >> 1 & 1, c & 1)) for c in range(8)], -1).all(-1)
    case = (corners.long() << torch.arange(8, device=device)).sum(-1) * whole
    fans, counts = case_table(str(device))
    triangle = torch.arange(fans.shape[1], device=device) < counts[case][..., None]
    b, i, j, k, nth = triangle.nonzero().unbind(-1)
    edges = fans[case[b, i, j, k], nth].long()
    corner, axis = edges // 3, edges % 3
    i, j, k = i[:, None] + (corner >> 2), j[:, None] + (corner >> 1 & 1), k[:, None] + (corner & 1)
    owner = neighbours[b[:, None], (i // SIDE) * 4 + (j // SIDE) * 2 + k // SIDE]
    faces = index[owner.clamp_min(0), i % SIDE, j % SIDE, k % SIDE, axis]
    return vertices, mixed, faces
