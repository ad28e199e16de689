"""Reference implementation: all pairs of pixels at once."""

import torch
from torch import Tensor
from torch.nn.functional import pad

from ..rasterize_mesh.reference import planes
from . import MAX_FACES


def run(picture: Tensor, depth: Tensor, found: Tensor, corners: Tensor, faces: Tensor, neighbours: Tensor) -> Tensor:
    height, width, channels = picture.shape
    number = torch.arange(height * width, device=picture.device).view(height, width)
    a = torch.cat([number[:, :-1].flatten(), number[:-1].flatten()])
    b = torch.cat([number[:, 1:].flatten(), number[1:].flatten()])
    differ = found.view(-1)[a] != found.view(-1)[b]
    a, b = a[differ], b[differ]
    axis = (b - a != 1).long()[:, None] if width > 1 else torch.ones_like(a)[:, None]
    ends = silhouettes(a, b, axis, depth, found, corners.detach(), faces, neighbours)
    there = ends[:, 0] >= 0
    a, b, axis, ends = a[there], b[there], axis[there], ends[there]

    (along_i, across_i), (along_j, across_j) = (_turned(corners[end, :2] / corners[end, 2:], axis) for end in ends.T)
    along, across = _turned(_centre(a, width, corners), axis)
    share = (across - across_i) / (across_j - across_i)
    s = (along_i + share * (along_j - along_i) - along - 0.5).clamp(-0.5, 0.5)[:, None]
    flat = picture.view(-1, channels)
    change = flat[a] - flat[b]
    return flat.index_add(0, b, s.clamp_min(0) * change).index_add(0, a, s.clamp_max(0) * change).view_as(picture)


@torch.no_grad()
def silhouettes(a, b, axis, depth, found, corners, faces, neighbours) -> Tensor:
    """Vertices of the silhouette edge of the nearer surface between each pair of pixels; -1 for none."""
    ends = torch.full((len(a), 2), -1, device=a.device)
    away = depth.view(-1).where(found.view(-1) >= 0, torch.inf)
    near = torch.where(away[a] <= away[b], a, b)
    begin, end = (pad(_centre(x, depth.shape[1], corners), (0, 1), value=1.0) for x in (near, a + b - near))
    face, pair = found.view(-1)[near].long(), torch.arange(len(a), device=a.device)
    for _ in range(MAX_FACES):
        if not len(pair):
            break
        matrix, _ = planes(corners[faces[face].long()])
        u, v = (torch.einsum("fij,fj->fi", matrix, x[pair]) for x in (begin, end))
        leaves = (v < u) & (v < 0)
        share, k = (u / (u - v)).where(leaves, torch.inf).min(-1)
        i, j = (faces[face, (k + n) % 3].long() for n in (1, 2))
        beyond = neighbours[face, k].long()
        before = (corners[faces[face].long(), 2] > 0).all(-1)
        further = (faces[beyond].sum(-1) - i - j).where(beyond >= 0, 0)
        turns = (matrix[torch.arange(len(k)), k] * corners[further]).sum(-1) > 0
        stops = leaves.any(-1) & before
        here = stops & ((beyond < 0) | (turns & (corners[further, 2] > 0)))
        ends[pair[here]] = torch.stack([i, j], -1)[here]
        goes = stops & ~here
        pair, face = pair[goes], beyond[goes]
    i, j = (corners[end, :2] / corners[end, 2:] for end in ends.T)
    (along, across) = _turned((i - j).abs(), axis)
    return ends.where((along <= across)[:, None], -1)


def _centre(pixel: Tensor, width: int, like: Tensor) -> Tensor:
    return torch.stack([pixel % width, pixel // width], -1).to(like) + 0.5


def _turned(x: Tensor, axis: Tensor) -> tuple[Tensor, Tensor]:
    """Coordinates along the axis of a pixel pair, and across it."""
    return x.gather(1, axis)[:, 0], x.gather(1, 1 - axis)[:, 0]
