"""Distance grid: signed distance at the corners of a cube, the smallest thing that learns from Shapes. For tests."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn

from lumigraph.camera.rays import Look, Samples
from lumigraph.datasets.shapes import Shapes
from lumigraph.files.ranges import BatchSize, Cells, LearningRate, NonNegative, RaySamples
from lumigraph.method import RayMethod


@dataclass(frozen=True)
class Config:
    cells: Cells = 24
    points: BatchSize = 1024  # per step
    samples: RaySamples = 24  # per ray
    sharpness: NonNegative = 40.0  # of the density, per scene unit (beta of Yariv 2021, VolSDF, is its inverse)
    learning_rate: LearningRate = 0.05


class DistanceGrid(RayMethod):
    Config, learns_from = Config, Shapes

    def __init__(self, frame, config):
        super().__init__(frame, config)
        n = config.cells + 1
        x = torch.linspace(-1, 1, n)
        radius = torch.stack(torch.meshgrid(x, x, x, indexing="ij")).norm(dim=0)
        self.values = nn.Parameter((radius - 0.7 + 0.01 * torch.randn(n, n, n))[None, None])  # about a ball

    @classmethod
    def smallest(cls):
        return Config(cells=12, points=256, samples=16)

    def batch(self, data, generator):
        return data.sample(self.config.points, generator).to(self.device)

    def loss(self, batch, step):
        error = (self.distance(batch.points) - batch.distance).abs().mean()
        self.figures = {"distance error": error.item()}
        return {"distance": error}

    def optimizers(self):
        return [torch.optim.Adam([self.values], lr=self.config.learning_rate)]

    def learning_rate(self, step, progress):
        return self.config.learning_rate * 0.03**progress

    def distance(self, points):
        """Interpolated in the cube; outside of it, that of the nearest point of the cube and the way there."""
        within = points.clamp(-1, 1)
        grid = nn.functional.grid_sample(self.values, within.flip(-1)[None, None, None], align_corners=True)
        return grid.flatten() + (points - within).norm(dim=-1)

    def density(self, points):
        """Laplace's distribution of the distance (VolSDF, eq. 2): half of it at the surface."""
        s = -self.config.sharpness * self.distance(points)
        return self.config.sharpness * torch.where(
            s <= 0, 0.5 * s.clamp(max=0).exp(), 1 - 0.5 * (-s.clamp(min=0)).exp()
        )

    def looks(self, rays):
        """Even samples where each ray passes the ball around the cube; colours are where the surface faces."""
        count, closest = self.config.samples, -(rays.origins * rays.directions).sum(-1, keepdim=True)
        half = 3**0.5
        step = 2 * half / count
        start = ((closest - half).clamp_min(1e-3) + step * torch.arange(count, device=self.device)).reshape(-1)
        samples = Samples(start, start + step, torch.arange(len(rays) + 1, device=self.device) * count)
        points, _ = samples.along(rays)
        apart = 2 / self.config.cells * torch.eye(3, device=self.device)
        here = self.distance(points)
        slope = torch.stack([self.distance(points + x) - here for x in apart], -1)
        return [Look("samples", samples, self.density(points), 0.5 + 0.5 * nn.functional.normalize(slope, dim=-1))]
