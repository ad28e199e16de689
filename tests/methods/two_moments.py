"""Two moments: a voxel grid of the first moment and one of the last, blended by time. For tests of controls."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn

from lumigraph.camera.rays import Look, Samples
from lumigraph.files.ranges import BatchSize, Cells, LearningRate, RaySamples
from lumigraph.method import RayMethod
from lumigraph.method.controls import Control, moment
from lumigraph.volume import composite


@dataclass(frozen=True)
class Config:
    cells: Cells = 12
    rays_per_step: BatchSize = 256
    samples: RaySamples = 24  # per ray
    learning_rate: LearningRate = 0.1


class TwoMoments(RayMethod):
    Config = Config

    def __init__(self, frame, config):
        super().__init__(frame, config)
        self.grids = nn.Parameter(0.1 * torch.randn(2, 4, *[config.cells] * 3))

    @classmethod
    def smallest(cls):
        return Config(cells=8, rays_per_step=128, samples=16)

    @property
    def controls(self):
        brightness = Control("brightness", 1.0, (0.0, 2.0), about="A factor on the scene's colours.")
        ink = Control("ink", "colour", choices=("colour", "grey"), about="What the scene is drawn with.")
        return (brightness, ink, moment(self.frame.times)) if self.frame.times else (brightness, ink)

    def render_rays(self, rays, background):
        (look,) = self.looks(rays)
        return composite(look.samples, look.density, look.rgb, background)

    def looks(self, rays):
        count, step = self.config.samples, 4 / self.config.samples
        start = torch.linspace(1.0, 5.0 - step, count).repeat(len(rays))
        samples = Samples(start, start + step, torch.arange(len(rays) + 1) * count)
        points, _ = samples.along(rays)
        places = points.flip(-1).expand(2, 1, 1, -1, 3)
        first, last = nn.functional.grid_sample(self.grids, places, align_corners=True)[:, :, 0, 0].mT
        late = self.share(rays)[samples.ray_index, None]
        values = (1 - late) * first + late * last
        density = nn.functional.softplus(10 * values[:, 0] - 2) * (points.abs() < 1).all(-1)
        rgb = torch.sigmoid(10 * values[:, 1:]) * self.control("brightness")
        if self.control("ink") == "grey":
            rgb = rgb.mean(-1, keepdim=True).expand(-1, 3)
        return [Look("samples", samples, density, rgb)]

    def share(self, rays):
        """0 at the first moment of the capture, 1 at the last."""
        first, last = self.frame.times or (0.0, 1.0)
        return (self.moments(rays) - first) / (last - first)

    def loss(self, batch, step):
        error = (self.render_rays(batch.rays, self.background).rgb - batch.before(self.background)).square().mean()
        self.figures = {"mse": error.item()}
        return {"colour": error}

    def optimizers(self):
        return [torch.optim.Adam([self.grids], lr=self.config.learning_rate)]
