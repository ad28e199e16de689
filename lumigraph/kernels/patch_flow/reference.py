"""The definition: the pixels of all patches at once, (row, column, pixel)."""

import torch
from torch import Tensor

from . import MIN_GRADIENT


def run(start, first, second, gradient, size, stride, iterations) -> Tensor:
    height, width = first.shape
    rows, columns = start.shape[:2]
    along = torch.arange(size, device=start.device)
    y = stride * torch.arange(rows, device=start.device)[:, None, None, None] + along[:, None]
    x = stride * torch.arange(columns, device=start.device)[:, None, None] + along
    y, x = (z.expand(rows, columns, size, size).flatten(2) for z in (y, x))
    at = y.clamp(0, height - 1), x.clamp(0, width - 1)
    T, g = first[at], gradient[at]
    g = g - g.mean(2, keepdim=True)
    eye = torch.eye(2, dtype=start.dtype, device=start.device)
    H = torch.einsum("rcpi,rcpj->rcij", g, g) + MIN_GRADIENT * eye
    u = start
    for _ in range(iterations):
        S = look_up(second, x + u[..., :1], y + u[..., 1:])
        u = u - torch.linalg.solve(H, (g * (S - T)[..., None]).sum(2)[..., None])[..., 0]
    far = (u - start).norm(dim=-1, keepdim=True) > size
    return torch.where(far, start, u)


def look_up(picture: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Values between four pixels; the border's beyond it."""
    height, width = picture.shape
    x, y = x.clamp(0, width - 1), y.clamp(0, height - 1)
    left, top = x.floor().long(), y.floor().long()
    right, below = (left + 1).clamp(max=width - 1), (top + 1).clamp(max=height - 1)
    fx, fy = x - left, y - top
    above = (1 - fx) * picture[top, left] + fx * picture[top, right]
    return (1 - fy) * above + fy * ((1 - fx) * picture[below, left] + fx * picture[below, right])
