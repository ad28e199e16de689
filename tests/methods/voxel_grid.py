"""Voxel grid: density and colour at the corners of a cube, the smallest thing that learns a scene. For tests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import nn

from lumigraph.camera.rays import Look, Rendering, Samples
from lumigraph.files.ranges import BatchSize, Layers, LearningRate, RaySamples, between
from lumigraph.method import RayMethod
from lumigraph.volume import composite


@dataclass(frozen=True)
class Grids:
    cells: Annotated[int, between(1, 64)] = 12
    channels: tuple[Layers, Layers] = (1, 3)


@dataclass(frozen=True)
class Config:
    rays: BatchSize = 256  # per step
    samples: RaySamples = 24  # per ray
    learning_rate: LearningRate = 0.1  # decays to a tenth
    momentum: bool = False  # a second kind of optimizer for the colours
    grids: Grids = Grids()


class VoxelGrid(RayMethod):
    Config = Config

    def __init__(self, frame, config):
        super().__init__(frame, config)
        n, (a, b) = config.grids.cells, config.grids.channels
        self.logits = nn.Parameter(0.1 * torch.randn(1, a, n, n, n))
        self.colour = nn.Parameter(0.1 * torch.randn(1, b, n, n, n))
        self.register_buffer("steps", torch.zeros((), dtype=torch.int64))

    @classmethod
    def smallest(cls):
        return Config(rays=128, samples=16, momentum=True, grids=Grids(cells=8))

    def batch(self, scene, generator):
        batch = scene.sample_rays(self.config.rays, generator)
        self.jitter = torch.rand(len(batch), 1, generator=generator)
        return batch

    def render_rays(self, rays, background, jitter=0.5):
        (look,) = self.looks(rays, jitter)
        return composite(look.samples, look.density, look.rgb, background)

    def looks(self, rays, jitter=0.5):
        count = self.config.samples
        edges = torch.linspace(1.0, 5.0, count + 1).expand(len(rays), -1)
        step = 4 / count
        start = (edges[:, :-1] + (jitter - 0.5) * step).reshape(-1)
        samples = Samples(start, start + step, torch.arange(len(rays) + 1) * count)
        points, _ = samples.along(rays)
        grid = torch.cat([self.logits, self.colour], 1)
        values = nn.functional.grid_sample(grid, points.flip(-1)[None, None, None], align_corners=True)[0, :, 0, 0].T
        inside = (points.abs() < 1).all(-1)
        density = nn.functional.softplus(10 * values[:, 0] - 2) * inside
        return [Look("samples", samples, density, torch.sigmoid(10 * values[:, 1:]))]

    def loss(self, batch, step):
        background = torch.tensor([self.frame.background])
        seen = self.render_rays(batch.rays, background, self.jitter)
        error = (seen.rgb - batch.before(background)).square().mean()
        self.mse = error.item()
        return {"colour": error, "thin": 1e-4 * self.logits.abs().mean()}

    def optimizers(self):
        if not self.config.momentum:
            self.kept = [torch.optim.Adam([self.logits, self.colour], lr=self.config.learning_rate)]
        else:
            self.kept = [
                torch.optim.Adam([self.logits], lr=self.config.learning_rate, amsgrad=True),
                torch.optim.SGD([self.colour], lr=self.config.learning_rate, momentum=0.9),
            ]
        return self.kept

    def before_step(self, step, progress):
        for optimizer in self.kept:
            for group in optimizer.param_groups:
                group["lr"] = self.config.learning_rate * 0.1**progress

    def after_step(self, step):
        self.steps += 1

    def statistics(self):
        return {"mse": self.mse, "samples": self.config.rays * self.config.samples}

    def render(self, camera) -> Rendering:
        assert not self.training
        return super().render(camera)
