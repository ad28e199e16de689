"""Appearance of photographs: affine colours and a sky for each, where photographs are found to differ."""

from __future__ import annotations

import copy
import warnings
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ...camera import Camera
from ...camera.rays import Rendering
from ...components.fields.appearance import PhotographCodes
from ...components.training.lights import spread_of_light
from ...components.training.schedules import falling
from ...datasets.scene import Frame, Photograph, Scene
from ...errors import LumigraphWarning
from ...files.ranges import LearningRate, NonNegative
from ...gaussians import Gaussians
from ...method.controls import Control
from .addition import Addition, Step
from .affine_colours import COLOUR_NUMBERS, fit_colours, recoloured, recoloured_harmonics
from .cloud import CloudAdam
from .interval_schedule import short_schedule_lr_scale
from .sky import SKY_NUMBERS, mean_skies, sky, sky_harmonics, sky_loss

MIN_SPREAD = 0.3  # stops between neighbouring photographs, beyond which each has an appearance
FULL_SCHEDULE_PASSES = 400  # steps for each photograph, from which on the learning rate is not scaled
MAX_LR_SCALE = 6.0  # of the learning rate, in short runs


@dataclass(frozen=True)
class AppearanceNumbers:
    """A Config's numbers of the appearance of photographs."""

    appearance: Literal["auto", "yes", "no"] = "auto"  # colours for each photograph; auto: where photographs differ
    own_skies: bool = True  # with appearance, learn a sky for each photograph of an open capture
    appearance_lr: LearningRate = 5e-3  # learning rate of these colours and skies at first
    final_appearance_lr: LearningRate = 5e-4  # learning rate of these at the end of the budget
    appearance_regularization: NonNegative = 1e-3  # weight of their squares in the loss; higher: closer to one light


class SplatAppearance(Addition):
    """A code for each photograph: affine colours, then a sky in scenes without bounds.

    differ: whether photographs are of different appearance; nothing is learnt where they are not
    found:  code of a photograph that was given as evidence
    """

    differ: Tensor
    found: Tensor | None = None

    def __init__(self, frame: Frame, numbers: AppearanceNumbers):
        super().__init__()
        self.numbers = numbers
        self.has_sky = numbers.own_skies and frame.is_open and not frame.has_alpha
        self.codes = PhotographCodes(frame.image_count, COLOUR_NUMBERS + SKY_NUMBERS * self.has_sky)
        self.register_buffer("differ", torch.tensor(numbers.appearance == "yes"))

    @property
    def is_active(self) -> bool:
        return bool(self.differ)

    # Training

    @torch.no_grad()
    def begin(self, method: Any, data: Scene, seconds: float) -> None:
        """Find out whether photographs differ, with the setting auto; begin with uniform skies."""
        if self.numbers.appearance == "auto":
            stops = spread_of_light(data) or 0.0
            self.differ.fill_(stops > MIN_SPREAD)
            if self.is_active:
                warnings.warn(
                    f"Neighbouring photographs differ by {stops:.1f} stops, so each has colours of its own, and what "
                    "moved between them is left out; `--appearance no` takes all for the same light",
                    LumigraphWarning,
                    stacklevel=3,
                )
        if self.is_active and self.has_sky:
            self.codes.codes[:, COLOUR_NUMBERS:] = mean_skies(data).to(self.differ.device)

    def after_raster(self, method: Any, step: Step) -> None:
        if not self.is_active or step.camera.image_index is None:
            return
        code, opacity = self.codes(step.camera.image_index)[0], step.picture.opacity
        step.rgb = recoloured(step.rgb, opacity, code)
        if self.has_sky:
            step.background = sky(code[COLOUR_NUMBERS:], step.photograph.camera)
            step.terms["sky"] = sky_loss(step.background, step.photograph, opacity)
        weight = self.numbers.appearance_regularization
        step.terms["appearance"] = weight * code[:COLOUR_NUMBERS].square().sum()

    def optimizers(self) -> list[torch.optim.Optimizer]:
        """One row a step has a gradient, as with Gaussians."""
        return [CloudAdam([{"name": "appearance", "params": [self.codes.codes], "lr": self.numbers.appearance_lr}])]

    def learning_rates(self, step: int, progress: float) -> dict[str, float]:
        full_schedule = FULL_SCHEDULE_PASSES * len(self.codes.codes)
        rate = falling(self.numbers.appearance_lr, self.numbers.final_appearance_lr, progress)
        return {"appearance": short_schedule_lr_scale(step, progress, full_schedule, MAX_LR_SCALE) * rate}

    # Rendering

    def shown(
        self, method: Any, seen: Rendering, camera: Camera, background: Float[Tensor, "... 3"]
    ) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "... 3"]]:
        code = self.code(method)
        if code is None:
            return seen.rgb, background
        rgb = recoloured(seen.rgb, seen.opacity, code).clamp(0, 1)
        return rgb, sky(code[COLOUR_NUMBERS:], camera).clamp(0, 1) if self.has_sky else background

    def recoloured_cloud(self, method: Any, cloud: Gaussians) -> Gaussians:
        code = self.code(method)
        return cloud if code is None else replace(cloud, harmonics=recoloured_harmonics(cloud.harmonics, code))

    def code(self, method: Any) -> Float[Tensor, " number"] | None:
        """The code of the control, else of a photograph given as evidence, else the average; None where photographs do
        not differ."""
        if not self.is_active:
            return None
        if self.found is not None and "appearance" not in method.settings:
            return self.found
        return self.codes.code_of(str(method.control("appearance"))).detach()

    # Settings

    @property
    def controls(self) -> tuple[Control, ...]:
        about = (
            "The photograph, by number or name, in whose light and colours the scene is shown; or the average of all."
        )
        return (self.codes.control("appearance", about),) if self.is_active else ()

    @property
    def accepts(self) -> tuple[type, ...]:
        """Photographs, where their colours were learnt to differ."""
        return (Photograph,) if self.is_active else ()

    @torch.no_grad()
    def adapted(self, method: Any, evidence: Photograph) -> SplatAppearance:
        """The part with the code in which the cloud looks most like the trusted pixels of a photograph; the average,
        where there is none."""
        photograph, background = evidence.to(method.device), method.background[0]
        seen = method.rasterized(photograph.camera)
        target, trusted = photograph.before(background), photograph.mask
        if trusted is None:
            trusted = torch.ones_like(seen.opacity, dtype=torch.bool)
        behind = sky_harmonics(photograph.camera)[trusted] if self.has_sky else None
        if behind is None:
            target = target - (1 - seen.opacity[..., None]) * background
        adapted, start = copy.copy(self), self.codes.average
        adapted.found = fit_colours(start, seen.rgb[trusted], seen.opacity[trusted], target[trusted], behind)
        method.settings.pop("appearance", None)
        return adapted
