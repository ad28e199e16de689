"""Parts of Block-NeRF: exposure as an input, parts of photographs that move, visibility (Tancik 2022)."""

from __future__ import annotations

import copy
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from ... import kernels
from ...camera.rays import Rays, Samples
from ...components.fields.encodings import FrequencyEncoding
from ...components.fields.hash_field import side_by_side
from ...components.fields.layers import MLP
from ...components.fields.spaces import Space
from ...components.training.regularizers import normalized_distance
from ...components.training.schedules import falling
from ...datasets.scene import Photograph, Scene
from ...method import Part
from ...method.controls import Control
from ...method.field import Directions, Points

FULL = 8.0  # stops that count as 1, so that the longest wave rises all the way from four below the usual to four above
SAME = 0.01  # stops within which all photographs count as exposed alike


class Exposures(Part):
    """The log exposure of each photograph, in stops from the median one, encoded as waves (section 4.2.3).

    usual: log2 of the training photographs' median exposure; 0 if unknown
    stops: of each photograph relative to it, 0 if unknown
    known: mask of photographs with a known exposure
    span:  smallest and largest training exposure
    taken: stops of an evidence photograph
    """

    taken: float | None = None
    usual: Tensor
    stops: Tensor
    known: Tensor
    span: Tensor

    def __init__(self, image_count: int, octaves: int):
        super().__init__()
        self.encode = FrequencyEncoding(1, octaves)
        self.width = self.encode.width
        self.register_buffer("usual", torch.tensor(0.0))
        self.register_buffer("stops", torch.zeros(image_count))
        self.register_buffer("known", torch.zeros(image_count, dtype=torch.bool))
        self.register_buffer("span", torch.zeros(2))

    def begin(self, method: object, data: Scene, seconds: float) -> None:
        if "exposure" not in data.about:
            return
        stops, train = data.about["exposure"].to(self.stops).log2(), data.splits["train"]  # NaN where not known
        known = stops.isfinite()
        learnt = stops[train][known[train]]
        if not len(learnt):
            return
        self.usual.copy_(learnt.median())
        self.known.copy_(known)
        self.stops.copy_(torch.where(known, stops - self.usual, 0.0))
        self.span.copy_(torch.stack([learnt.min(), learnt.max()]) - self.usual)

    def forward(self, image: Int[Tensor, " ray"]) -> Float[Tensor, "ray width"]:
        return self.encoded(self.stops)[image]

    def encoded(self, stops: Float[Tensor, " value"]) -> Float[Tensor, "value width"]:
        """Stops from the usual exposure as waves."""
        return self.encode(stops[:, None] / FULL)

    @property
    def usual_stops(self) -> float | None:
        return float(self.usual) if self.known.any() else None

    def stops_of(self, image: int) -> float | None:
        """Stops of one photograph from the usual exposure; None where it is not known."""
        return float(self.stops[image]) if self.known[image] else None

    # Settings

    @property
    def controls(self) -> tuple[Control, ...]:
        """Control of the exposure within the training range; none if all exposures are equal."""
        least, most = self.span.tolist()
        if most - least < SAME:
            return ()
        about = "As if photographed with so much more or less exposure than usual, within what was photographed."
        return (Control("exposure", 0.0, (least, most), unit="stops", about=about),)

    def shown(self, method: Any) -> Float[Tensor, " width"]:
        """The code of the settings, else of the evidence, else of the usual exposure."""
        stops = method.settings.get("exposure", 0.0 if self.taken is None else self.taken)
        return self.encoded(self.usual.new_tensor([float(stops)]))[0]

    @property
    def accepts(self) -> tuple[type, ...]:
        """Photographs, where exposures are known."""
        return () if self.usual_stops is None else (Photograph,)

    def adapted(self, method: object, evidence: Photograph) -> Exposures:
        """The part with the exposure of an evidence photograph, found by its camera's `image_index`."""
        adapted, image = copy.copy(self), evidence.camera.image_index
        adapted.taken = None if image is None else self.stops_of(int(image[0]))
        return adapted


CELLS = 32  # along each side of a photograph
BEGINS, EVERY = 0.2, 100  # share of the budget before anything is judged, and steps between judgements
MEMORY = 0.7  # of a cell's error, that is kept when it is looked at again
STILL = 0.9  # share of cells that may always teach
MUCH = 2.5  # times the median error of its photograph, below which a cell teaches in any case


class Moving(Part):
    """Mask of transient objects from running errors of cells of each photograph.

    error: running mean absolute error of each cell; 0 before the first
    still: 1 for cells that are trained on, else 0
    """

    error: Tensor
    still: Tensor

    def __init__(self, image_count: int):
        super().__init__()
        self.register_buffer("error", torch.zeros(image_count, CELLS, CELLS))
        self.register_buffer("still", torch.ones(image_count, CELLS, CELLS))

    def weights(self, image: Int[Tensor, " ray"], place: Float[Tensor, "ray 2"]) -> Float[Tensor, " ray"]:
        """1 for rays that are trained on, else 0. place: on the picture, shares of its width and height"""
        return self.still.flatten()[cell_of(image, place)]

    @torch.no_grad()
    def note(self, image: Int[Tensor, " ray"], place: Float[Tensor, "ray 2"], error: Float[Tensor, " ray"]) -> None:
        """Update the running absolute errors of rays' cells."""
        seen, which = cell_of(image, place).unique(return_inverse=True)
        total = torch.zeros(len(seen)).to(error).index_add_(0, which, error)
        mean = total / which.bincount(minlength=len(seen))
        before = self.error.view(-1)[seen]
        self.error.view(-1)[seen] = torch.where(before > 0, torch.lerp(mean, before, MEMORY), mean)

    @torch.no_grad()
    def judge(self) -> None:
        """Select cells to train on: their error and their neighbours' is below that of most, or close to their
        photograph's."""
        known = self.error > 0
        if not known.any():
            return
        around = functional.avg_pool2d(self.error[:, None], 3, 1, 1)[:, 0]
        around = around / functional.avg_pool2d(known.float()[:, None], 3, 1, 1)[:, 0].clamp_min(1e-6)
        most = around[known].kthvalue(max(1, int(STILL * int(known.sum())))).values
        usual = torch.where(known, around, torch.nan).flatten(1).nanmedian(1).values[:, None, None]
        self.still.copy_((around <= most) | (around <= MUCH * usual) | ~known)

    def before_step(self, method: object, step: int, progress: float) -> None:
        if progress >= BEGINS and step % EVERY == 0:
            self.judge()


def cell_of(image: Int[Tensor, " ray"], place: Float[Tensor, "ray 2"]) -> Int[Tensor, " ray"]:
    """The number of the cell, of all photographs' cells, that each ray passes."""
    column, row = (place * CELLS).long().clamp_(0, CELLS - 1).unbind(-1)
    return (image * CELLS + row) * CELLS + column


BANDS = 3  # of spherical harmonics: from which side, and no more than that
LEARNING_RATES = 5e-3, 5e-4  # at first and in the end
HORIZON = 0.99  # of normalized_distance distances, where rays that do not end are asked about last


class Visibility(Part):
    """f_v(x, d) in [0, 1]: visibility of x from photographs that look along d (Tancik 2022, section 4.2).

    It is trained on the transmittance of a field along the rays of photographs, without gradients to the field.

    octaves: of the encoding of points
    layers, width: hidden ones
    """

    def __init__(self, space: Space, octaves: int, layers: int, width: int):
        super().__init__()
        self.space, self.encode = space, FrequencyEncoding(3, octaves)
        self.network = MLP(self.encode.width + BANDS**2, *[width] * layers, 1)

    def forward(self, points: Points, directions: Directions) -> Float[Tensor, " point"]:
        """points: in scene units; directions: unit length, away from the eye"""
        places = self.encode(self.space.warp(points))
        return self.network(side_by_side(places, kernels.spherical_harmonics(directions, BANDS)))[:, 0].sigmoid()

    def error(
        self, rays: Rays, samples: Samples, density: Float[Tensor, " sample"], generator: torch.Generator
    ) -> Float[Tensor, ""]:
        """The mean squared error at one random place of each ray, near ones and far ones alike."""
        with torch.no_grad():
            first, last = (normalized_distance(t).clamp(max=HORIZON) for t in self.space.interval(rays))
            s = torch.lerp(first, last, torch.rand(len(rays), generator=generator).to(first))
            t = s / (1 - s)
            light = transmittance(samples, density, t)
        return (self(rays.at(t).detach(), rays.directions.detach()) - light).square().mean()

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return [torch.optim.Adam([{"params": [*self.parameters()], "name": "visibility"}], LEARNING_RATES[0])]

    def learning_rates(self, step: int, progress: float) -> dict[str, float]:
        return {"visibility": falling(*LEARNING_RATES, progress)}


def transmittance(
    samples: Samples, density: Float[Tensor, " sample"], t: Float[Tensor, " ray"]
) -> Float[Tensor, " ray"]:
    """T = exp(-integral of density from the eye to t): the transmittance up to a distance along each ray."""
    ray = samples.ray_index
    passed = torch.minimum(t[ray] - samples.t_start, samples.length).clamp_min(0)
    return torch.exp(-torch.zeros_like(t).index_add(0, ray, density * passed))
