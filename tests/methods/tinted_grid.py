"""Tinted grid: one voxel grid for all scenes of a Collection, in the mean colour of what each shows. For tests."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn

from lumigraph.camera.rays import Look, Samples
from lumigraph.datasets.collection import Collection
from lumigraph.datasets.scene import Scene
from lumigraph.files.ranges import BatchSize, Cells, LearningRate, RaySamples
from lumigraph.method import RayMethod
from lumigraph.volume import composite


@dataclass(frozen=True)
class Config:
    cells: Cells = 12
    rays: BatchSize = 256  # per step
    samples: RaySamples = 24  # per ray
    seen: BatchSize = 1024  # pixels that tell a member's colour
    learning_rate: LearningRate = 0.1


class TintedGrid(RayMethod):
    Config, learns_from, accepts = Config, Collection, (Scene,)

    def __init__(self, frame, config):
        super().__init__(frame, config)
        self.logits = nn.Parameter(0.1 * torch.randn(1, 1, *[config.cells] * 3))
        self.shade = nn.Parameter(0.1 * torch.randn(1, 3, *[config.cells] * 3))
        self.register_buffer("tint", torch.full((3,), 0.5))  # the member's that is seen

    @classmethod
    def smallest(cls):
        return Config(cells=8, rays=128, samples=16, seen=128)

    def tint_of(self, scene, generator):
        """The mean colour of what is opaque in a scene's photographs."""
        seen = scene.sample_rays(self.config.seen, generator)
        weight = torch.ones(len(seen)) if seen.alpha is None else seen.alpha
        return (weight[:, None] * seen.rgb).sum(0) / weight.sum().clamp_min(1e-6)

    def take_evidence(self, evidence, controls):
        for scene in evidence[-1:]:
            self.frame = scene.frame
            self.tint = self.tint_of(scene, torch.Generator().manual_seed(0)).to(self.device)

    def batch(self, data, generator):
        _, scene = data.sample_member(generator)
        self.tint.copy_(self.tint_of(scene, generator))
        return scene.sample_rays(self.config.rays, generator).to(self.device)

    def looks(self, rays):
        """Even samples from 1 to 5."""
        edges = torch.linspace(1.0, 5.0, self.config.samples + 1).expand(len(rays), -1)
        samples = Samples.rows(edges[:, :-1], edges[:, -1])
        points, _ = samples.along(rays)
        grid, place = torch.cat([self.logits, self.shade], 1), points.flip(-1)[None, None, None]
        values = nn.functional.grid_sample(grid, place, align_corners=True)[0, :, 0, 0].T
        density = nn.functional.softplus(10 * values[:, 0] - 2) * (points.abs() < 1).all(-1)
        rgb = torch.sigmoid(10 * values[:, 1:]) * 2 * self.tint
        return [Look("samples", samples, density, rgb)]

    def loss(self, batch, step):
        (look,) = self.looks(batch.rays)
        seen = composite(look.samples, look.density, look.rgb, self.background)
        error = (seen.rgb - batch.before(self.background)).square().mean()
        self.figures = {"mse": error.item()}
        return {"colour": error}

    def optimizers(self):
        return [torch.optim.Adam([self.logits, self.shade], lr=self.config.learning_rate)]
