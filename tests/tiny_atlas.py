"""A ball of fog, as a field and as a small atlas, for tests of what is baked."""

from __future__ import annotations

import torch

from lumigraph import methods
from lumigraph.components.fields.deferred import Deferred
from lumigraph.datasets.scene import Frame
from lumigraph.method import Method

RADIUS, DENSITY = 0.6, 4.0
WALL, WIDE = 1.0, 0.4


def ball(points: torch.Tensor) -> Deferred:
    """A ball of fog, its colour where a point is, its features all the same."""
    density = DENSITY * (points.norm(dim=-1) < RADIUS).float()
    return Deferred(density, colour(points), torch.full((len(points), 4), 0.25))


def room(points: torch.Tensor) -> Deferred:
    """The ball, and around it a wall of fog that is thickest at a distance of 2.5."""
    inner = ball(points)
    return inner._replace(density=inner.density + WALL * torch.exp(-((points.norm(dim=-1) - 2.5) / WIDE).square()))


def colour(points: torch.Tensor) -> torch.Tensor:
    return (0.4 + points / 2.4).clamp(0, 1)


def baked(frame: Frame | None = None, diffuse: bool = False, density: float = 1.0, field=ball, **numbers) -> Method:
    """A method that holds the ball, so many times as dense; its small network says something, unless it is diffuse."""
    kind = methods.find("snerg")
    config = kind.Config(**{**vars(kind.smallest()), **numbers})
    method = kind(frame or Frame(near=0.1, background=(1.0, 1.0, 1.0), has_alpha=True, image_count=12), config)
    if diffuse:
        method.view.take(None)
    else:
        generator = torch.Generator().manual_seed(0)
        with torch.no_grad():
            for parameter in method.view.parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.5)
    method.sightings.weight.fill_(1.0)
    method._bake(lambda points: field(points)._replace(density=density * field(points).density))
    return method.eval()
