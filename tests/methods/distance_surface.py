"""Distance surface: a grid of signed distances (density after Yariv 2021), sampled up to each ray's first surface."""

from dataclasses import dataclass

import torch
from torch import nn

from lumigraph.camera.rays import Samples
from lumigraph.files.ranges import Cells, Seed
from lumigraph.method import Field, FieldMethod, Pass, Sampler


@dataclass(frozen=True)
class Config:
    cells: Cells = 16
    seed: Seed = 0


class DistanceGrid(Field):
    def __init__(self, cells):
        super().__init__()
        corners = torch.stack(torch.meshgrid(*[torch.linspace(-1, 1, cells)] * 3, indexing="ij"))
        distance, colours = corners.norm(dim=0, keepdim=True) - 0.6, 0.1 * torch.randn(3, cells, cells, cells)
        self.values = nn.Parameter(torch.cat([distance, colours])[None])

    def geometry(self, points, code=None):
        places = points.flip(-1)[None, None, None]
        found = nn.functional.grid_sample(self.values, places, align_corners=True, padding_mode="border")[0, :, 0, 0].T
        return 40 * torch.sigmoid(-20 * found[:, 0]) * (points.abs() < 1).all(-1), found

    def colour(self, features, directions, code=None):
        return torch.sigmoid(10 * features[:, 1:])


class SurfaceSampler(Sampler):
    batch_size = expected_rays = 128

    def sample(self, rays, field, code=None, generator=None):
        samples = Samples.rows(torch.linspace(1, 4.9, 48).expand(len(rays), -1), torch.full((len(rays),), 5.0))
        with torch.no_grad():
            inside = field.geometry(samples.along(rays)[0])[1][:, 0].view(len(rays), -1) < 0
            samples = samples.keep((inside.cumsum(-1) < 4).flatten())  # as far as a little behind the first surface
        points, directions = samples.along(rays)
        return [Pass("surface", samples, *field.geometry(points), directions, evaluated=len(samples))]


class DistanceSurface(FieldMethod):
    Config = Config

    def __init__(self, frame, config):
        super().__init__(frame, config)
        self.network, self.sampler = DistanceGrid(config.cells), SurfaceSampler()

    @classmethod
    def smallest(cls):
        return Config(cells=8)

    def optimizers(self):
        return [torch.optim.Adam([self.network.values], 0.02)]
