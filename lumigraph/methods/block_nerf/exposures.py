"""Exposure as an input: what a camera was set to is known, and need not be learnt (Tancik 2022, section 4.2.3)."""

from __future__ import annotations

import copy
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...components.fields.encodings import FrequencyEncoding
from ...datasets.scene import Photograph, Scene
from ...method import Part
from ...method.controls import Control

FULL = 8.0  # stops that count as 1, so that the longest wave rises all the way from four below the usual to four above
SAME = 0.01  # stops within which all photographs count as exposed alike


class Exposures(Part):
    """The log exposure of each photograph, in stops from the usual one, as waves (section 4.2.3).

    usual: log2 of the median exposure of the photographs that are learnt from; 0 where none is known
    stops: of each photograph from there, 0 where it is not known
    known: whether it is
    span:  the least and the most that is learnt from
    taken: stops of a photograph that was given as evidence
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

    def begin(self, method: Any, data: Scene, seconds: float) -> None:
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
        """Of one photograph, from the usual; None where it is not known."""
        return float(self.stops[image]) if self.known[image] else None

    # Settings

    @property
    def controls(self) -> tuple[Control, ...]:
        """Exposure within what was learnt from; none where all photographs were exposed alike."""
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

    def adapted(self, method: Any, evidence: Photograph) -> Exposures:
        """The part with the exposure of a photograph, where its camera's `image_index` tells."""
        adapted, image = copy.copy(self), evidence.camera.image_index
        adapted.taken = None if image is None else self.stops_of(int(image[0]))
        return adapted
