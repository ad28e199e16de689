"""Reference implementation: windows of all pixels at once, (P, M, samples, ...), one neighbour after the other."""

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from . import BEHIND_DEPTH, MIN_VARIANCE


def run(reference, trust, neighbours, neighbour_trust, warps, pixels, views, planes, window, deviation) -> Tensor:
    height, width = reference.shape
    dx, dy = torch.tensor(window, device=reference.device).T
    row, column = pixels[:, None] // width + dy, pixels[:, None] % width + dx
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    index = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    a = reference.flatten()[index]
    unlike = (a - reference.flatten()[pixels, None]) ** 2 / (2 * deviation**2)
    apart = (dx**2 + dy**2).to(reference) / (2 * (window[-1][1] + 1) ** 2)
    w = torch.where(inside, trust.flatten()[index] * torch.exp(-unlike - apart), 0)[:, None]
    inverse_depth = planes[..., :1] + planes[..., 1:2] * dx + planes[..., 2:] * dy  # (P, M, K)
    places = torch.stack([column + 0.5, row + 0.5, torch.ones_like(row)], -1).to(reference)[:, None]  # (P, 1, K, 3)

    def cost(picture: Tensor, its_trust: Tensor, warp: Tensor) -> Tensor:
        there = places @ warp[:, :3].T + inverse_depth[..., None] * warp[:, 3]
        seen, weighted = look_up(torch.stack([its_trust, its_trust * picture]), there)
        n, b = w * seen, weighted / seen.clamp_min(1e-12)
        total = n.sum(-1, keepdim=True).clamp_min(1e-12)
        off_a, off_b = (x - (n * x).sum(-1, keepdim=True) / total for x in (a[:, None], b))
        variance_a, variance_b, covariance = (
            (n * x).sum(-1) / total[..., 0] for x in (off_a**2, off_b**2, off_a * off_b)
        )
        share = n.sum(-1) / w.sum(-1).clamp_min(1e-12)
        return 1 - share * covariance / ((variance_a + MIN_VARIANCE) * (variance_b + MIN_VARIANCE)).sqrt()

    costs = torch.stack([cost(*one) for one in zip(neighbours, neighbour_trust, warps, strict=True)], -1)
    return costs.gather(2, views[:, None].expand(-1, planes.shape[1], -1))


def look_up(pictures: Tensor, places: Tensor) -> Tensor:
    """Bilinear interpolation (picture, pixel, plane, sample) at homogeneous coordinates; zero outside."""
    rows, columns = pictures.shape[1:]
    behind = places[..., 2:] <= BEHIND_DEPTH
    at = places[..., :2] / torch.where(behind, 1, places[..., 2:]) * (2 / places.new_tensor([columns, rows])) - 1
    at = torch.where(behind, -4, at)  # from -1 to 1 is inside
    found = grid_sample(pictures[None], at.flatten(1, 2)[None], align_corners=False)[0]
    return found.view(len(pictures), *at.shape[:-1])
