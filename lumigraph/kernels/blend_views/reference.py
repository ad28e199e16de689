"""Reference implementation: penalties of all photographs at all points, (V, P), then the least of them."""

import torch
from torch import Tensor

from . import BEHIND_DEPTH, MIN_PENALTY, NOTHING, UNSEEN


def run(
    points, eyes, focal, pictures, depths, sizes, poses, lenses, count, resolution_weight, hidden_weight, tolerance,
    border,
):  # fmt: skip
    """Look up every photograph at every point."""
    penalties, shares, colours = [], [], []
    own, wanted = (points - eyes).norm(dim=-1), torch.nn.functional.normalize(points - eyes, dim=-1)
    for picture, depth, size, pose, lens in zip(pictures, depths, sizes, poses, lenses, strict=True):
        local = points @ pose[:, :3].T + pose[:, 3]
        away, centre = local.norm(dim=-1), -pose[:, 3] @ pose[:, :3]
        u, v, valid = place(local, lens)
        share = torch.stack([u, size[0] - u, v, size[1] - v], -1) / size[[0, 0, 1, 1]]
        share = torch.where(valid, (share.amin(-1) / border).clamp(0, 1), 0)
        t = torch.stack(corners(depth, u / size[0] * size[2], v / size[1] * size[3], size[2:])[0], -1)
        apart = torch.where(t < NOTHING, (away[:, None] - t).abs(), 0)
        gap = torch.where(t > 0, apart, UNSEEN).amin(-1) / away.clamp_min(BEHIND_DEPTH)
        share = torch.where((t > 0).any(-1), share, 0)
        chord = (wanted - torch.nn.functional.normalize(points - centre, dim=-1)).norm(dim=-1)
        coarse = (away * focal / (own * (lens[0] * lens[1]).sqrt()) - 1).clamp_min(0)
        penalty = chord * (1 + hidden_weight * (gap - tolerance).clamp(0, 1)) + resolution_weight * coarse
        penalties.append(torch.where(share > 0, penalty, UNSEEN))
        shares.append(share)
        (a, b, c, d), (x, y) = corners(picture, u, v, size[:2])
        x, y = x[:, None], y[:, None]
        rgb = (1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d)
        colours.append(rgb / 255)
    penalty, share, rgb = torch.stack(penalties), torch.stack(shares), torch.stack(colours)
    least = penalty.sort(0).values
    last = least[count] if count < len(penalty) else torch.full_like(own, UNSEEN)
    weight = share * (1 - penalty / last.clamp_min(MIN_PENALTY)).clamp_min(0) / (penalty + MIN_PENALTY)
    weight = torch.where(penalty < UNSEEN, weight, 0)
    # Of several photographs with the same penalty as the last one none would have a weight.
    weight = torch.where((weight.sum(0) > 0) | (penalty >= UNSEEN), weight, share)
    total = weight.sum(0)
    found = (weight[..., None] * rgb).sum(0) / total.clamp_min(1e-12)[:, None]
    return found, torch.where(weight > 0, share, 0).amax(0)


def place(local: Tensor, lens: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (u, v) of points in camera coordinates, and a mask of those inside the view."""
    x, y, z = local.unbind(-1)
    valid = z > BEHIND_DEPTH
    x, y = (torch.where(valid, a / torch.where(valid, z, 1), 0) for a in (x, y))
    k1, k2, p1, p2, k3, k4, k5, k6 = lens[4:12]
    s = x * x + y * y
    q = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
    u = x * q + 2 * p1 * x * y + p2 * (s + 2 * x * x)
    v = y * q + p1 * (s + 2 * y * y) + 2 * p2 * x * y
    return u * lens[0] + lens[2], v * lens[1] + lens[3], valid & (s <= lens[12] ** 2)


def corners(values: Tensor, u: Tensor, v: Tensor, size: Tensor):
    """Values of the four pixels around points of a picture, and the interpolation weights to the right and down."""
    x, y = ((at.nan_to_num(0.5) - 0.5).clamp_min(0).minimum(side - 1) for at, side in zip((u, v), size, strict=True))
    left, top = x.floor().long(), y.floor().long()
    right, below = (left + 1).minimum(size[0] - 1), (top + 1).minimum(size[1] - 1)
    found = values[top, left], values[top, right], values[below, left], values[below, right]
    return found, (x - left, y - top)
