"""A ball of fog with a shining side, as a field and as a small atlas, for tests of what is baked."""

from __future__ import annotations

import torch

from lumigraph import methods
from lumigraph.baked import Atlas
from lumigraph.components.fields.deferred import Deferred
from lumigraph.method import Method
from lumigraph.scene import Frame

RADIUS, DENSITY = 0.6, 4.0


class Ball:
    """A teacher: its colour is where a point is, and a little of the direction that it is seen along."""

    def __init__(self, shine: float = 0.0):
        self.shine = shine

    def density(self, points: torch.Tensor) -> torch.Tensor:
        return DENSITY * (points.norm(dim=-1) < RADIUS).float()

    def field(self, points: torch.Tensor, directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.density(points), colour(points) + self.shine * directions[:, :1].clamp_min(0)

    def deferred(self, points: torch.Tensor) -> Deferred:
        return Deferred(self.density(points), colour(points), 0.25 + 0 * points[:, [0, 1, 2, 0]])


def colour(points: torch.Tensor) -> torch.Tensor:
    return (0.4 + points / 2.4).clamp(0, 1)


def baked(frame: Frame | None = None, seed: int = 0, **numbers) -> Method:
    """A method that holds the ball, as everybody sees it."""
    kind = methods.find("snerg")
    config = kind.Config(**{**vars(kind.smallest()), **numbers})
    method = kind(frame or Frame(near=0.1, background=(1.0, 1.0, 1.0), has_alpha=True, image_count=12), config)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in method.view.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.5)
    method.sightings.weight.fill_(1.0)
    method._bake(Ball().deferred)
    return method.eval()


def atlas(**numbers) -> Atlas:
    return baked(**numbers).atlas()
