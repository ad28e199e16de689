"""Reference implementation in PyTorch."""

import torch

from ..block_hash import SIDE
from . import BEHIND_DEPTH, UNCOLOURED


def offsets(like):
    """(i, j, k) of a block's voxels, k fastest."""
    axis = torch.arange(SIDE, device=like.device)
    return torch.cartesian_prod(axis, axis, axis).to(like)


def sample_maps(points, depth, rgb, trust, pose, lens, edge):
    """Interpolated depth, colour and trust in the direction of points, and a mask of known ones; see `fuse_depth`."""
    height, width = depth.shape
    q = (points - pose[:, 3]) @ pose[:, :3]
    before = q[:, 2] > BEHIND_DEPTH
    x, y = (q[:, :2] / torch.where(before, q[:, 2], 1)[:, None] * lens[:2] + lens[2:]).unbind(-1)
    inside = before & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    x, y = torch.where(inside, x, 0), torch.where(inside, y, 0)
    u, v = (x - 0.5).clamp(0, width - 1), (y - 0.5).clamp(0, height - 1)
    left, top = u.floor().long(), v.floor().long()
    right, below = (left + 1).clamp(max=width - 1), (top + 1).clamp(max=height - 1)
    u, v = u - left, v - top
    corners = torch.stack([depth[top, left], depth[top, right], depth[below, left], depth[below, right]])
    known = corners.isfinite() & (corners > 0)
    smooth = known.all(0) & (corners.amax(0) - corners.amin(0) <= edge * corners.amin(0))
    weights = torch.stack([(1 - v) * (1 - u), (1 - v) * u, v * (1 - u), v * u])

    nearest = torch.where(known, weights, -1).argmax(0)[None]

    def blend(values):
        corners = torch.stack([values[top, left], values[top, right], values[below, left], values[below, right]])
        share = weights.view(*weights.shape, *(1,) * (values.ndim - 2))
        one = corners.take_along_dim(nearest.view(1, -1, *(1,) * (values.ndim - 2)), 0)[0]
        choice = smooth.view(-1, *(1,) * (values.ndim - 2))
        return torch.where(choice, (share * corners).sum(0), one)

    return blend(depth), blend(rgb), blend(trust), inside & known.any(0)


def run(voxels, blocks, depth, rgb, trust, pose, lens, voxel, truncation, edge, max_weight, growth):
    for number, block in enumerate(blocks):
        points = voxel * (SIDE * block.to(voxels) + offsets(voxels))
        surface, colour, w, known = sample_maps(points, depth, rgb, trust, pose, lens, edge)
        d, reach = (surface - (points - pose[:, 3]).norm(dim=-1)) / truncation, 1 + growth / truncation * surface
        changed = known & (d >= -reach) & (w > 0)
        distance, weight, own = voxels[number, :, 0], voxels[number, :, 1], voxels[number, :, 2:]
        share = w / (weight + w).clamp_min(1e-30)
        within = (changed & (d < reach))[:, None]
        mixed = torch.where((own[:, :1] == UNCOLOURED), colour, own + share[:, None] * (colour - own))
        voxels[number] = torch.cat(
            [
                torch.where(changed, distance + share * (d.minimum(reach) - distance), distance)[:, None],
                torch.where(changed, (weight + w).clamp(max=max_weight), weight)[:, None],
                torch.where(within, mixed, own),
            ],
            1,
        )
