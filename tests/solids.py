"""Methods that have learnt exact solids, and cameras around them, for tests of what is made of surfaces."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.camera.rays import Rendering
from lumigraph.datasets.scene import Frame
from lumigraph.geometry import look_at
from lumigraph.method import RayMethod

SHARPNESS, SOLID = 200.0, 400.0  # of the density's rise, per scene unit; density inside
Distance = Callable[[torch.Tensor], torch.Tensor]


def ball(radius: float = 0.6, centre=(0.0, 0.0, 0.0)) -> Distance:
    return lambda points: (points - torch.tensor(centre)).norm(dim=-1) - radius


def torus(ring: float = 0.55, tube: float = 0.2) -> Distance:
    def distance(points):
        return torch.hypot(points[:, :2].norm(dim=-1) - ring, points[:, 2]) - tube

    return distance


def shell(radius: float = 0.6, thickness: float = 0.15) -> Distance:
    return lambda points: ((points.norm(dim=-1) - radius + thickness / 2).abs()) - thickness / 2


def together(*parts: Distance) -> Distance:
    return lambda points: torch.stack([part(points) for part in parts]).amin(0)


def painted(points: torch.Tensor) -> torch.Tensor:
    """The colour of a place."""
    return (0.5 + 0.4 * points).clamp(0, 1)


class Seen(RayMethod):
    """A solid known by its signed distance, seen by sphere tracing; it has no density."""

    Config = dict

    def __init__(self, distance: Distance, frame: Frame | None = None):
        super().__init__(frame or Frame(near=0.1, background=(1.0, 1.0, 1.0), has_alpha=True), {})
        self.shape, self.nothing = distance, torch.nn.Parameter(torch.zeros(1))

    def batch(self, scene, generator):
        raise NotImplementedError

    def loss(self, batch, step):
        raise NotImplementedError

    def optimizers(self):
        return []

    def render_rays(self, rays, background):
        t = torch.zeros(len(rays))
        for _ in range(40):
            t = t + self.shape(rays.at(t))
        hit = self.shape(rays.at(t)).abs() < 1e-3
        rgb = torch.where(hit[:, None], painted(rays.at(t)), background)
        return Rendering(rgb, torch.where(hit, t, torch.inf), hit.float())


class Solid(Seen):
    """The same with a density."""

    def density(self, points):
        return SOLID * torch.sigmoid(-SHARPNESS * self.shape(points))


class Measured(Solid):
    """The same with a signed distance too."""

    def distance(self, points):
        return self.shape(points)


def around(count: int = 24, size: int = 80, lowest: float = -90.0, distance: float = 3.0) -> Camera:
    """Cameras evenly over a sphere, above a latitude in degrees, that look at the origin."""
    k = torch.arange(count) + 0.5
    low = math.sin(math.radians(lowest))
    z = low + (1 - low) * k / count
    angle = k * math.pi * (3 - math.sqrt(5))
    flat = (1 - z * z).sqrt()
    position = distance * torch.stack([flat * angle.cos(), flat * angle.sin(), z], -1)
    lens = Pinhole(torch.full((count, 2), 1.3 * size), torch.full((count, 2), size / 2))
    pose = look_at(position, -position, torch.tensor([0.0, 0.01, 1.0]))
    return Camera(pose, lens, torch.full((count, 2), size))
