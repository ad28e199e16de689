"""Fourier features: a network that learns a picture from its coordinates, as waves (Tancik 2020, arXiv 2006.10739)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ..camera.rays import Rays, Rendering
from ..components.fields.encodings import FourierEncoding
from ..components.fields.layers import Dense
from ..datasets.scene import Batch, Frame, Scene
from ..files.ranges import BatchSize, Depth, LearningRate, NonNegative, Width, between
from ..method import BaseConfig, RayMethod, seeded

Encoding = Literal["none", "basic", "positional", "gaussian"]
FEW = 16  # inputs to a layer below which it multiplies in float32: in bfloat16 alone they tell no pixel from the next


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers for pictures (section 6.1, and its appendix on implementation); those of a step are ours."""

    encoding: Encoding = "gaussian"  # encoding of coordinates ahead of the network, section 6.1; none gives a blur
    scale: NonNegative = 10.0  # sigma, section 6.1: of gaussian the deviation, of positional the highest; higher: finer
    frequencies: Annotated[int, between(2, 65_536)] = 256  # rows of B, for positional and gaussian; more cost time
    layers: Depth = 4  # layers of the network, the last of which gives colours; more cost time
    hidden_width: Width = 256  # channels of hidden layers; wider learns more detail, and costs time
    learning_rate: LearningRate = 1e-3  # Adam's learning rate; higher learns faster, and may diverge
    pixels_per_step: BatchSize = 1 << 13  # random pixels in a step; more reduce noise, and cost time. The paper: all
    exact: bool = False  # multiply in float32 even where bfloat16 is faster; slower and more precise


SOURCES = {  # of the numbers of `paper`; the others are ours
    "tancik/fourier-feature-networks, Experiments/2d_image_regression.ipynb (9c110c3)": (
        "encoding frequencies layers hidden_width learning_rate"
    ),
    "tancik/fourier-feature-networks, Demo.ipynb (9c110c3)": "scale",
}


class FourierFeatures(RayMethod):
    """The wall y = 0, painted: gamma encodes a place on it, and a network gives the colour there.

        rgb(v) = sigmoid(W_n relu(... relu(W_1 gamma(v) + b_1) ...) + b_n)

    It learns what photographs show of that wall. A picture, as a scene (`capture.picture`), shows nothing else.
    """

    Config = Config

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        rows = frequencies(c)
        self.encoding = nn.Identity() if rows is None else FourierEncoding(rows)
        widths = [2 if rows is None else 2 * len(rows), *[c.hidden_width] * (c.layers - 1)]
        with seeded(c.seed):
            hidden = [Dense(a, b, relu=True, exact=c.exact or a < FEW) for a, b in pairwise(widths)]
            self.layers = nn.Sequential(*hidden, Dense(c.hidden_width, 3, exact=True))

    @classmethod
    def smallest(cls) -> Any:
        """A few waves and a narrow network, which learn within some twenty quick steps."""
        return Config(scale=1.0, frequencies=16, layers=3, hidden_width=32, pixels_per_step=256, learning_rate=1e-2)

    def paint(self, place: Float[Tensor, "point 2"]) -> Float[Tensor, "point 3"]:
        """The colour at places in [0, 1]^2, x to the right and y down, the longer side of the picture being 1."""
        return torch.sigmoid(self.layers(self.encoding(place)))

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        t, place, hit = self.meet(rays)
        rgb = background.expand(len(rays), 3).clone()
        rgb[hit] = self.paint(place[hit])
        return Rendering(rgb, t.where(hit, math.inf), hit.float())

    def meet(self, rays: Rays) -> tuple[Float[Tensor, " ray"], Float[Tensor, "ray 2"], Bool[Tensor, " ray"]]:
        """Intersections of rays with the wall: distance, place, and a mask of those within the scene's bounds."""
        t = -rays.origins[:, 1] / rays.directions[:, 1]
        x, _, z = rays.at(t).unbind(1)
        (left, _, bottom), (right, _, top) = self.frame.bounds
        hit = (t > 0) & (left <= x) & (x <= right) & (bottom <= z) & (z <= top)
        return t, torch.stack([1 + x, 1 - z], 1) / 2, hit

    def batch(self, scene: Scene, generator: torch.Generator) -> Batch:
        return scene.sample_rays(self.config.pixels_per_step, generator).to(self.device)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        background = self.background
        error = (self.render_rays(batch.rays, background).rgb - batch.before(background)).square().mean()
        self.figures = {"mse": float(error.detach())}
        return {"mse": error}

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return [torch.optim.Adam(self.parameters(), self.config.learning_rate, foreach=True)]


def frequencies(config: Config) -> Float[Tensor, "frequency 2"] | None:
    """B of the encodings (section 6.1): gamma(v) = (cos(2 pi B v), sin(2 pi B v)); None leaves v as it is.

    basic:       B = I
    positional:  sigma^(j/m) along either axis, j = 0 ... m - 1, m being half the number of frequencies
    gaussian:    independent numbers from N(0, sigma^2)
    """
    count, scale, generator = config.frequencies, config.scale, torch.Generator().manual_seed(config.seed)
    match config.encoding:
        case "none":
            return None
        case "basic":
            return torch.eye(2)
        case "positional":
            return torch.kron(torch.eye(2), (scale ** (torch.arange(count // 2) / (count // 2)))[:, None])
        case "gaussian":
            return scale * torch.randn(count, 2, generator=generator, device="cpu")
