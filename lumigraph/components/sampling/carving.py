"""Space carving: what a photograph sees through is empty (Kutulakos and Seitz 2000)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from ...camera import PIXEL_RADIUS, Camera
from ...datasets.scene import Scene
from ...geometry import evenly

VIEWS = 24  # photographs asked at most: more cut little further


@torch.no_grad()
def visual_hull(scene: Scene, resolution: int, coarsest: int = 32) -> Bool[Tensor, "x y z"]:
    """Cells of a grid over [-1, 1]^3 that no training photograph with alpha sees through, from coarse to fine.

    Conservative: a cell stays unless some photograph is transparent wherever the ball around the cell projects.
    """
    train = scene.splits["train"]
    chosen = evenly(train.tolist(), VIEWS)
    photographs = [scene.photograph(index) for index in chosen]
    views = [(photograph.camera, photograph.alpha) for photograph in photographs if photograph.alpha is not None]
    n = coarsest
    hull = torch.ones(n, n, n, dtype=torch.bool)
    while True:
        cells = hull.nonzero()
        for camera, alpha in views:
            centres = (cells + 0.5) * (2 / n) - 1
            cells = cells[~_seen_through(camera, alpha, centres, math.sqrt(3) / n)]
        hull = torch.zeros_like(hull)
        hull[tuple(cells.t())] = True
        if n >= resolution:
            return hull
        n *= 2
        hull = hull.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)


def _seen_through(
    camera: Camera, alpha: Float[Tensor, "height width"], centres: Float[Tensor, "cell 3"], radius: float
) -> Bool[Tensor, " cell"]:
    """Whether all pixels around each ball's projection are transparent. Balls outside the picture are not known."""
    if not len(centres):
        return torch.zeros(0, dtype=torch.bool)
    height, width = alpha.shape
    per_pixel = float(camera.rays(torch.tensor([[width / 2, height / 2]])).radius) / PIXEL_RADIUS
    nearest = float((centres - camera.position).norm(dim=-1).min()) - radius
    if nearest <= radius:
        return torch.zeros(len(centres), dtype=torch.bool)
    reach = math.ceil(radius / (nearest * per_pixel)) + 1
    around = alpha[None]
    for size in ((2 * reach + 1, 1), (1, 2 * reach + 1)):
        around = max_pool2d(around, size, 1, (size[0] // 2, size[1] // 2))
    places, inside = camera.locate(centres)
    return inside & (around[0][places.unbind(-1)] == 0)
