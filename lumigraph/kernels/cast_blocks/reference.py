"""Reference implementation in PyTorch: every ray evaluates every step."""

import torch

from ..block_hash import SIDE
from ..block_hash.reference import find

GREY = 0.5


def corners(points, voxels, blocks, table, voxel):
    """The eight voxels around points, z fastest, their trilinear weights, and a mask of those with an observation."""
    base = (points / voxel).floor()
    part, base = points / voxel - base, base.int()
    steps = torch.cartesian_prod(*[torch.arange(2, dtype=torch.int32, device=points.device)] * 3)
    places = base[..., None, :] + steps
    number = find(places.div(SIDE, rounding_mode="floor"), blocks, table)
    x, y, z = (places % SIDE).long().unbind(-1)
    if not len(blocks):
        voxels = voxels.new_zeros(1, SIDE**3, voxels.shape[2])
    found = voxels[number.clamp_min(0), (x * SIDE + y) * SIDE + z]
    share = torch.where(steps.bool(), part[..., None, :], 1 - part[..., None, :])
    return found, share, (number >= 0) & (found[..., 1] > 0)


def run(origins, directions, t_near, t_far, voxels, blocks, table, voxel, step):
    given = voxels, blocks, table, voxel
    found = torch.full_like(t_near, torch.inf)
    before, k = torch.full_like(t_near, torch.nan), 0
    while len(t_near) and (alive := found.isinf() & (t_near + k * step < t_far)).any():
        t = t_near + k * step
        values, share, known = corners(origins + t[:, None] * directions, *given)
        distance = (share.prod(-1) * values[..., 0]).sum(-1)
        distance[~known.all(-1)] = torch.nan
        through = alive & (before >= 0) & (distance < 0)
        found = torch.where(through, t - step + step * before / (before - distance), found)
        before, k = distance, k + 1
    values, share, known = corners(origins + found.nan_to_num(posinf=0.0)[:, None] * directions, *given)
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).to(values)
    slope = torch.stack(
        [
            (signs[:, a] * share[..., [b for b in range(3) if b != a]].prod(-1) * values[..., 0]).sum(-1)
            for a in range(3)
        ],
        -1,
    )
    length = slope.norm(dim=-1, keepdim=True)
    sloped = known.all(-1, keepdim=True) & (length > 1e-6) & found.isfinite()[:, None]
    normal = torch.where(sloped, slope / length.clamp_min(1e-6), -directions)
    coloured = share.prod(-1) * (known & (values[..., 2] >= 0))
    total = coloured.sum(-1, keepdim=True)
    rgb = (coloured[..., None] * values[..., 2:]).sum(-2) / total.clamp_min(1e-6)
    return found, normal, torch.where((total > 1e-6) & found.isfinite()[:, None], rgb, GREY)
