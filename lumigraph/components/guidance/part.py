"""Guidance: a part that optimises a scene for a prompt through random views, by CLIP or by score distillation, with the
transmittance prior (Jain 2022, arXiv 2112.01455; Poole 2022, arXiv 2209.14988)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ...datasets.words import Words
from ...errors import LumigraphError
from ...files.ranges import NonNegative, Pixels, PositiveShare, Share, Steps, between
from ...method import Part
from .guides import DistillationNumbers, Guide
from .opening import open_guide
from .views import (
    PromptedViews,
    before_backgrounds,
    camera_around,
    cropped,
    degrees_between,
    named_view,
    opacity_target,
)

Degrees = Annotated[float, between(-90, 90)]
MIN_ELEVATION = 30.0  # degrees above the horizon, of the lowest cameras
MAX_ELEVATION = 30.0  # degrees above the horizon, of the highest cameras
CAMERA_DISTANCE = 4.0  # distance of cameras from the origin, in scene units


@dataclass(frozen=True)
class GuidanceNumbers:
    """A Config's numbers of text guidance: Jain 2022, section 4 and the released code."""

    render_width: Pixels = 168  # pixels a side of a training view; more show detail and cost time
    crop_share: PositiveShare = 154 / 168  # width of a random crop as a share of the view; less: stronger augmentation
    views_per_step: Annotated[int, between(1, 64)] = 8  # views of a step, each of its own camera; more are steadier
    crops_per_view: Annotated[int, between(1, 64)] = 8  # crops of a view, each before a random background
    focal: Annotated[float, between(0.2, 10)] = 1.2  # focal length in widths of the picture; longer: larger scene
    transmittance_weight: NonNegative = 0.5  # weight of the transmittance prior, lambda of eq. 6; 0: off, more clutter
    initial_opacity: PositiveShare = 0.5  # mean opacity that the prior allows at first; falls to final_opacity
    final_opacity: PositiveShare = 0.1  # mean opacity that the prior allows in the end; higher: larger scenes
    opacity_steps: Steps = 500  # steps in which the allowed opacity falls
    origin_decay: Share = 0.999  # share of the scene's centre kept in a step, which cameras follow; 1: fixed
    view_prompts: Literal["auto", "yes", "no"] = "auto"  # name the view in the prompt; auto: for diffusion models


# Views for a plain CPU, in which a small model recognises shapes, and for tests.
CPU_GUIDANCE = GuidanceNumbers(
    render_width=40,
    crop_share=0.9,
    views_per_step=1,
    crops_per_view=6,
    focal=1.9,
    final_opacity=0.06,
    opacity_steps=100,
    origin_decay=0.99,
)
TINY_GUIDANCE = GuidanceNumbers(
    render_width=16, views_per_step=1, crops_per_view=2, transmittance_weight=2.0, opacity_steps=1
)


class Guidance(Part):
    """Loss terms of a scene's views for a prompt.

    origin: running mean of the scene's centre of mass, target of the cameras
    """

    origin: Tensor

    def __init__(self, numbers: GuidanceNumbers, distillation: DistillationNumbers = DistillationNumbers()):
        super().__init__()
        self.numbers, self.distillation = numbers, distillation
        self.register_buffer("origin", torch.zeros(3))
        self.guide: Guide | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> Guidance:
        """A copy with its own buffer; the guide, which is not trained, is shared."""
        copied = Guidance(self.numbers, self.distillation).train(self.training)
        copied.origin, copied.guide = self.origin.clone(), self.guide
        memo[id(self)] = copied
        return copied

    def views(self, words: Words, generator: torch.Generator) -> PromptedViews:
        """Random cameras around the scene, with their prompts. Raises LumigraphError without guidance."""
        n = self.numbers
        if words.guidance is None:
            raise LumigraphError(
                "Words need a model that judges pictures by them; give --guidance FOLDER, with CLIP or a diffusion "
                "model, or train a small one: lumigraph train captions"
            )
        self.guide = open_guide(words.guidance, self.origin.device)
        azimuth = degrees_between(0.0, 360.0, n.views_per_step, generator)
        elevation = degrees_between(MIN_ELEVATION, MAX_ELEVATION, n.views_per_step, generator)
        naming = self.guide.named_views if n.view_prompts == "auto" else n.view_prompts == "yes"
        names = [named_view(a, e) for a, e in zip(azimuth.tolist(), elevation.tolist(), strict=True)]
        prompts = tuple(f"{words.prompt}, {name}" if naming else words.prompt for name in names)
        camera = camera_around(azimuth, elevation, CAMERA_DISTANCE, n.focal, n.render_width, self.origin)
        return PromptedViews(camera, prompts)

    def terms(
        self, rgba: Float[Tensor, "view 4 height width"], views: PromptedViews, step: int, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Guidance and transmittance prior of premultiplied views (Jain 2022, eq. 6).

        The prior is lambda max(0, tau - mean(T)), which has the gradient of the paper's -lambda min(tau, mean(T)).
        """
        n = self.numbers
        assert self.guide is not None
        crops = [cropped(x, n.crops_per_view, n.crop_share, self.guide.pixels, generator) for x in rgba]
        pictures = before_backgrounds(torch.cat(crops), generator)
        prompts = tuple(prompt for prompt in views.prompts for _ in range(n.crops_per_view))
        terms = {"guidance": self.guide.loss(pictures, prompts, generator, self.distillation)}
        if n.transmittance_weight:
            allowed = opacity_target(
                n.initial_opacity, n.final_opacity, n.opacity_steps, step, n.focal, CAMERA_DISTANCE
            )
            excess = (rgba[:, 3].mean() - allowed).clamp_min(0.0)
            terms["transmittance"] = n.transmittance_weight * excess
        return terms

    @torch.no_grad()
    def follow(self, points: Float[Tensor, "ray 3"], opacity: Float[Tensor, " ray"]) -> None:
        """Update the origin by the centre of mass of a step's views. points: of rays, weighted by opacity"""
        if (total := opacity.sum()) > 0:
            self.origin.lerp_((points.sum(0) / total).to(self.origin), 1 - self.numbers.origin_decay)
