"""Dream splats: a cloud of Gaussians learnt from words alone, by the guidance of CLIP or a diffusion model, after
DreamGaussian (Tang et al. 2024, arXiv 2309.16653)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from ..budget import Effort, Efforts
from ..camera import Camera
from ..camera.rays import Rendering
from ..components.clouds.cloud import Cloud, RateNumbers
from ..components.clouds.initialization import round_gaussians
from ..components.guidance import (
    CPU_GUIDANCE,
    TINY_GUIDANCE,
    DistillationNumbers,
    Guidance,
    GuidanceNumbers,
    PromptedViews,
)
from ..datasets.scene import Frame
from ..datasets.words import Words
from ..files.ranges import CloudSize, changed
from ..gaussians import Gaussians
from ..gaussians.splatting import render, splat, view_of
from ..method import BaseConfig, Method

GREY = 0.5  # colour of all Gaussians at first
INITIAL_RADIUS = 0.5  # radius of the ball that Gaussians fill at first, in scene units


@dataclass(frozen=True)
class Config(BaseConfig):
    """Tang 2024, section 3.1 and the released code (configs/text.yaml)."""

    rates: RateNumbers = RateNumbers(
        means_lr=1e-3, final_means_lr=2e-5, sh_lr=1e-2, scales_lr=5e-3, quaternions_lr=5e-3
    )
    guidance: GuidanceNumbers = GuidanceNumbers()
    distillation: DistillationNumbers = DistillationNumbers()
    initial_gaussians: CloudSize = 5000  # Gaussians of the cloud, whose number stays; more hold finer detail


SOURCES = {  # of the numbers of `paper`; the others are ours
    "dreamgaussian/dreamgaussian, configs/text.yaml (69a3c70)": (
        "initial_gaussians means_lr final_means_lr sh_lr opacities_lr scales_lr quaternions_lr"
    ),
    "dreamgaussian/dreamgaussian, gs_renderer.py (69a3c70)": "initial_radius",
    "dreamgaussian/dreamgaussian, guidance/sd_utils.py (69a3c70)": "guidance_scale min_time max_time",
    "google-research/google-research, dreamfields/dreamfields/config/config_base.py (aca5f2e)": (
        "crops_per_view min_elevation max_elevation camera_distance focal transmittance_weight initial_opacity "
        "final_opacity opacity_steps"
    ),
    "google-research/google-research, dreamfields/dreamfields/config/config_mq.py (aca5f2e)": "render_width crop_share",
    "Jain 2022, section 4": "views_per_step origin_decay",
}


class DreamSplats(Method):
    """Gaussians in a ball, optimised so that random views match a prompt. Their number is constant."""

    Config, learns_from = Config, Words
    efforts: ClassVar[Efforts] = {"draft": Effort(1, 300), "good": Effort(1, 2000), "best": Effort(1, 10_000)}

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        chance = self.random(0)
        outward = torch.nn.functional.normalize(torch.randn(c.initial_gaussians, 3, generator=chance), dim=-1)
        radius = INITIAL_RADIUS * torch.rand(c.initial_gaussians, 1, generator=chance) ** (1 / 3)
        cloud = round_gaussians(radius * outward, torch.full_like(outward, GREY), 0)
        self.cloud, self.guidance = Cloud(cloud, c.rates), Guidance(c.guidance, c.distillation)
        self.centre: tuple[Tensor, Tensor] | None = None

    @classmethod
    def cpu_preset(cls) -> Any:
        """Fewer Gaussians that move faster, and the small views of `dream-fields`."""
        return changed(Config(guidance=CPU_GUIDANCE), means_lr=5e-3, final_means_lr=5e-4, sh_lr=2e-2, scales_lr=1e-2,
            initial_gaussians=1000)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """A few Gaussians and tiny views, with a prior so strong that 24 steps show it."""
        guidance = replace(TINY_GUIDANCE, transmittance_weight=10.0, initial_opacity=0.02, final_opacity=0.02)
        return replace(cls.cpu_preset(), guidance=guidance, initial_gaussians=200)

    def batch(self, data: Words, generator: torch.Generator) -> PromptedViews:
        return self.guidance.views(data, generator)

    def loss(self, batch: PromptedViews, step: int) -> dict[str, Tensor]:
        """Guidance of random views before random backgrounds, and the transmittance prior (Jain 2022, eq. 6)."""
        cloud = self.cloud.gaussians()
        seen = [splat(cloud, view_of(batch.camera[i], self.frame.near)) for i in range(len(batch))]
        rgba = torch.stack([torch.cat([x.rgb, x.opacity[..., None]], -1).movedim(-1, 0) for x in seen])
        weights = cloud.opacities.detach().sigmoid() * cloud.log_scales.detach().sum(-1).exp()
        self.centre = weights[:, None] * cloud.means.detach(), weights
        return self.guidance.terms(rgba, batch, step, self.random(step))

    def after_step(self, step: int) -> None:
        super().after_step(step)
        if self.centre is not None:
            self.guidance.follow(*self.centre)

    def gaussians(self) -> Gaussians:
        """The cloud in the scene's frame."""
        return self.cloud.gaussians()

    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        return render(self.gaussians(), camera.to(self.device), self.frame.background, self.frame.near)
