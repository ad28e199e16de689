"""Exposed methods: those that learn a gain for each photograph, where photographs are found to differ."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...controls import Control, Value
from ...scene import Frame, Photograph, Scene
from ..fields.appearance import drawn
from .corrections import Exposure, Setting, gain_between

FOUND_BY = 4096  # pixels of a photograph that tell its exposure


class Exposed(nn.Module):
    """What a RayMethod with `Exposure` has beside its own: what it learns, what it can be told, how it is told of a
    photograph. It stands before RayMethod among the bases.

    Methods call `expose` when they are made and `tell_exposed` when they begin, learn with `gains`, and show colours
    as `exposed` has them.
    """

    exposure: Exposure | None
    found_gain: Tensor | None = None  # of a photograph that was given
    config: Any
    random: Any
    device: Any
    told: dict[str, Value]

    def expose(self, frame: Frame, setting: Setting) -> None:
        self.exposure = Exposure(frame.image_count, setting) if setting != "no" else None

    def tell_exposed(self, scene: Scene) -> None:
        if self.exposure:
            self.exposure.begin(scene, self.config.exposure_correction)

    @property
    def gains(self) -> Exposure | None:
        """The photographs' gains; None where they are not told apart."""
        return self.exposure if self.exposure and bool(self.exposure.differ) else None

    def exposed(self, rgb: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Colours with the gain that was told, or found."""
        if self.found_gain is not None:
            rgb = rgb * self.found_gain
        return rgb * self.gains.gain(self.told) if self.told and self.gains else rgb

    @property
    def controls(self) -> tuple[Control, ...]:
        return self.gains.controls if self.gains else ()

    @property
    def accepts(self) -> tuple[type, ...]:
        """Photographs, where their exposures were learnt to differ."""
        return (Photograph,) if self.gains else ()

    def given(self, *evidence: Any, **controls: Value) -> Any:
        """The same scene, told its controls, or as bright as a photograph, by the pixels that are to be trusted."""
        photographs = [piece for piece in evidence if self.gains and isinstance(piece, Photograph)]
        others = (piece for piece in evidence if not (self.gains and isinstance(piece, Photograph)))
        told = super().given(*others, **controls)  # type: ignore[misc]  # the method's
        if "exposed_as" in controls:
            told.found_gain = None
        for photograph in photographs:
            told.found_gain = self._gain_of(photograph)
            told.told.pop("exposed_as", None)
        return told

    @torch.no_grad()
    def _gain_of(self, photograph: Photograph) -> Float[Tensor, " 3"]:
        """By how much a photograph is brighter than the scene as it was learnt."""
        batch = drawn(photograph, FOUND_BY, self.random(0)).to(self.device)
        if not len(batch):
            return torch.ones(3, device=self.device)
        plain = super().given()  # type: ignore[misc]
        plain.told, plain.found_gain = {}, None
        background = plain.background
        parts = [
            plain.render_rays(batch.rays[part], background).rgb
            for part in torch.arange(len(batch), device=self.device).split(plain.rays_per_chunk)
        ]
        return gain_between(torch.cat(parts), batch.before(background))
