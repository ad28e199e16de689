"""Reference implementation in PyTorch."""

import torch

from ..block_hash.reference import find


def rays(height, width, pose, lens):
    """Origin and unit directions (height, width, 3) of the pixels' rays."""
    y, x = torch.meshgrid(torch.arange(height).to(pose) + 0.5, torch.arange(width).to(pose) + 0.5, indexing="ij")
    directions = torch.stack([(x - lens[2]) / lens[0], (y - lens[3]) / lens[1], torch.ones_like(x)], -1)
    return pose[:, 3], torch.nn.functional.normalize(directions, dim=-1) @ pose[:, :3].T


def run(depth, pose, lens, blocks, table, side, truncation, steps):
    height, width = depth.shape
    origin, directions = rays(height, width, pose, lens)
    measured = depth.isfinite() & (depth > 0)
    shift = torch.linspace(-truncation, truncation, steps + 1).to(depth)
    t = depth[measured][:, None] + shift
    places = origin + t[..., None] * directions[measured][:, None]
    found = (places / side).floor().int().reshape(-1, 3).unique(dim=0)
    return found[find(found, blocks, table) < 0]
