"""Average: a cube of cells, each the mean of what photographs show of it, without any gradient. For tests."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from lumigraph.camera.rays import Look, Samples
from lumigraph.files.ranges import Cells, NonNegative, RaySamples, Share
from lumigraph.method import RayMethod

NEAR, FAR = 1.0, 5.0  # scene units from a camera, between which the cube lies


@dataclass(frozen=True)
class Config:
    cells: Cells = 32  # along each axis
    samples: RaySamples = 64  # per ray
    solid: Share = 0.9  # mean opacity from which on a cell is solid
    density: NonNegative = 50.0  # of a solid cell, per scene unit


class Average(RayMethod):
    """A cell that every photograph shows opaque is solid, and has the mean of the colours shown: a visual hull."""

    Config = Config

    def __init__(self, frame, config):
        super().__init__(frame, config)
        self.register_buffer("sums", torch.zeros(config.cells**3, 4))  # of opacity times colour, and of opacity
        self.register_buffer("counts", torch.zeros(config.cells**3))  # photographs that show the cell
        self.register_buffer("left", torch.tensor(-1))  # photographs to come

    @classmethod
    def smallest(cls):
        return Config(cells=16, samples=32)

    def begin(self, scene, seconds=0.0):
        self.left.fill_(len(scene.splits["train"]))

    @property
    def complete(self):
        return int(self.left) == 0

    def batch(self, scene, generator):
        return scene.photograph(int(scene.splits["train"][-max(int(self.left), 1)])).to(self.device)

    def step(self, batch, step, descend):
        n = self.config.cells
        axis = (torch.arange(n, device=self.device) + 0.5) * 2 / n - 1
        pixels, seen = batch.camera.project(torch.cartesian_prod(axis, axis, axis))
        seen &= ((pixels >= 0) & (pixels < batch.camera.size)).all(-1)
        x, y = pixels[seen].long().unbind(-1)
        alpha = torch.ones_like(batch.rgb[..., :1]) if batch.alpha is None else batch.alpha[..., None]
        self.sums[seen] += torch.cat([alpha * batch.rgb, alpha], -1)[y, x]
        self.counts[seen] += 1
        self.left -= 1
        self.figures = {"cells": float(seen.sum())}
        return {}

    def density(self, points):
        cell = self._cell(points)
        solid = self.sums[cell, 3] > self.config.solid * self.counts[cell].clamp_min(1)
        return self.config.density * (solid & (points.abs() < 1).all(-1))

    def looks(self, rays):
        count = self.config.samples
        edges = torch.linspace(NEAR, FAR, count + 1, device=self.device).expand(len(rays), -1)
        samples = Samples.rows(edges[:, :-1].contiguous(), edges[:, -1])
        points, _ = samples.along(rays)
        total = self.sums[self._cell(points)]
        return [Look("samples", samples, self.density(points), total[:, :3] / total[:, 3:].clamp_min(1e-6))]

    def _cell(self, points):
        n = self.config.cells
        x, y, z = ((points + 1) * (n / 2)).long().clamp(0, n - 1).unbind(-1)
        return (x * n + y) * n + z
