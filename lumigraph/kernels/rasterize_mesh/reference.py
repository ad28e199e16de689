"""Reference implementation: every triangle against every pixel, (F, 3, P)."""

import torch
from torch import Tensor


def run(corners: Tensor, attributes: Tensor, faces: Tensor, size: tuple[int, int], near: float):
    width, height = size
    y, x = torch.meshgrid(*(torch.arange(n, device=corners.device) + 0.5 for n in (height, width)), indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3).to(corners)
    found = nearest(corners.detach(), faces, pixels, near)

    seen = found >= 0
    triangle, place = faces[found[seen]].long(), pixels[seen]
    u = torch.linalg.solve(corners[triangle].mT, place)
    b = u / u.sum(-1, keepdim=True)
    values = corners.new_zeros(len(pixels), attributes.shape[1])
    values = values.index_put((seen,), (b[..., None] * attributes[triangle]).sum(1))
    depth = corners.new_zeros(len(pixels)).index_put((seen,), (b * corners[triangle, 2]).sum(1))
    return values.view(height, width, -1), depth.view(height, width), found.view(height, width)


def nearest(corners: Tensor, faces: Tensor, pixels: Tensor, near: float) -> Tensor:
    """Number of the visible triangle at each pixel; -1 for none."""
    if not len(faces):
        return torch.full((len(pixels),), -1, dtype=torch.int32, device=pixels.device)
    matrix, steep = planes(corners[faces.long()])
    found = []
    for some in pixels.split(max(1, 2**24 // len(faces))):
        u = matrix @ some.T
        w = u.sum(1)
        inside = (u >= 0).all(1) & steep[:, None] & (w > 0) & (w < 1 / near)
        closest, number = w.where(inside, 0.0).max(0)
        found.append(number.where(closest > 0, -1).int())
    return torch.cat(found)


def planes(corners: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse of each triangle's matrix M of corners, whose row i gives u_i, and a mask of invertible ones."""
    a, b, c = corners.unbind(1)
    adjugate = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], 1)
    volume = (adjugate[:, 0] * a).sum(-1)
    return adjugate / volume[:, None, None].where(volume[:, None, None] != 0, 1), volume != 0
