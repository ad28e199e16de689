"""Mean colour: every pixel has one learnt colour. The least that a method needs."""

from dataclasses import dataclass

import torch
from torch import nn

from lumigraph import Method
from lumigraph.camera.rays import Rendering
from lumigraph.files.ranges import LearningRate, Seed


@dataclass(frozen=True)
class Config:
    rate: LearningRate = 0.1
    seed: Seed = 0


class MeanColour(Method):
    """One colour."""

    Config = Config

    def __init__(self, frame, config):
        super().__init__(frame, config)
        self.colour = nn.Parameter(torch.full((3,), 0.5))

    def batch(self, data, generator):
        return data.sample_rays(256, generator)

    def loss(self, batch, step):
        return {"colour": (self.colour - batch.rgb).square().mean()}

    def optimizers(self):
        return [torch.optim.Adam(self.parameters(), lr=self.config.rate)]

    def render(self, camera):
        width, height = camera.size[0].tolist()
        depth = torch.ones(height, width)
        return Rendering(self.colour.detach().clamp(0, 1).expand(height, width, 3), depth, torch.ones_like(depth))
