"""Reference implementation: Barron 2022, eq. 10, halved, and the determinant of its Jacobian."""

import torch
from torch import Tensor


@torch.no_grad()
def run(points: Tensor, stretch: bool) -> tuple[Tensor, Tensor | None]:
    radius = points.norm(dim=-1).clamp_min(1)  # with 1, the equation for outside holds inside too
    across = (2 - 1 / radius) / (2 * radius)  # double eigenvalue of the Jacobian, at right angles to x
    along = 0.5 / radius.square()  # its eigenvalue along x
    return across[:, None] * points, (along * across.square()) ** (1 / 3) if stretch else None
