"""Dream Fields: a hash-grid field learnt from words alone, by the guidance of CLIP or a diffusion model (Jain et al.
2022, arXiv 2112.01455; Poole et al. 2022, arXiv 2209.14988)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from ..budget import Effort, Efforts
from ..camera.rays import Rays
from ..components.fields.hash_field import HashField, HashNumbers
from ..components.fields.spaces import space_of
from ..components.guidance import (
    CPU_GUIDANCE,
    TINY_GUIDANCE,
    DistillationNumbers,
    Guidance,
    GuidanceNumbers,
    PromptedViews,
)
from ..components.sampling.occupancy_sampler import OccupancyNumbers, StepNumbers
from ..components.sampling.samplers import TINY_HASH, ProposalNumbers, sampler_for, sampling_bytes
from ..components.training.schedules import hold_and_decay
from ..datasets.scene import Frame
from ..datasets.words import Words
from ..files.ranges import LearningRate, Width, changed
from ..method import BaseConfig, FieldMethod, seeded
from ..volume import composite

FINAL_LEARNING_RATE = 1e-3  # learning rate at the end of the budget, reached exponentially
DECAY_START = 0.3  # share of the budget before the learning rate falls


@dataclass(frozen=True)
class Config(BaseConfig):
    """Guidance by the paper's numbers; the field and its learning rates are Instant-NGP's."""

    table: HashNumbers = HashNumbers(sh_bands=1)
    occupancy: OccupancyNumbers = OccupancyNumbers(samples_per_step=1 << 20)
    steps: StepNumbers = StepNumbers(steps_per_diagonal=192)
    proposals: ProposalNumbers = ProposalNumbers()
    guidance: GuidanceNumbers = GuidanceNumbers()
    distillation: DistillationNumbers = DistillationNumbers()
    hidden_width: Width = 64  # neurons of a hidden layer; wider costs time
    learning_rate: LearningRate = 1e-2  # Adam's learning rate at first; higher: faster, may diverge


SOURCES = {  # of the numbers of `paper`; the others are ours
    "google-research/google-research, dreamfields/dreamfields/config/config_base.py (aca5f2e)": (
        "crops_per_view min_elevation max_elevation camera_distance focal transmittance_weight initial_opacity "
        "final_opacity opacity_steps steps_per_diagonal sh_bands"
    ),
    "google-research/google-research, dreamfields/dreamfields/config/config_mq.py (aca5f2e)": "render_width crop_share",
    "Jain 2022, section 4": "views_per_step origin_decay",
    "Poole 2022, section 3": "guidance_scale min_time max_time",
}


class DreamFields(FieldMethod):
    """A hash table in a box, optimised so that random views match a prompt."""

    Config, further_bytes, learns_from = Config, staticmethod(sampling_bytes), Words
    efforts: ClassVar[Efforts] = {"draft": Effort(1, 300), "good": Effort(1, 2000), "best": Effort(1, 10_000)}
    network: HashField

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        space = space_of(frame)
        with seeded(c.seed):
            self.network = HashField(c.table, c.hidden_width, space, frame.reach)
        self.sampler = sampler_for(frame, space, c.occupancy, c.proposals, steps=c.steps, adapts=False)
        self.guidance = Guidance(c.guidance, c.distillation)
        self.centre: tuple[Tensor, Tensor] | None = None

    @classmethod
    def cpu_preset(cls) -> Any:
        """Coarse tables and small views, larger in the picture, in which a small model recognises shapes."""
        return changed(Config(guidance=CPU_GUIDANCE), levels=4, features_per_level=4, log2_hashmap_size=15,
            base_resolution=8, max_resolution=48, samples_per_step=1 << 17, occupancy_resolution=32,
            steps_per_diagonal=72, hidden_width=32)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """Tiny tables, networks and views."""
        return Config(**TINY_HASH, guidance=TINY_GUIDANCE, hidden_width=16, learning_rate=2e-2)

    def batch(self, data: Any, generator: torch.Generator) -> Any:
        return self.guidance.views(data, generator)

    def loss(self, batch: Any, step: int) -> dict[str, Tensor]:
        """Guidance of random views before random backgrounds, and the transmittance prior (Jain 2022, eq. 6)."""
        generator, rays = self.random(step), rays_of(batch)
        (samples,), terms = self.learn(rays, generator)
        look = samples.look(self.network)
        points = look.samples.along(rays)[0].detach()
        seen = composite(look.samples, look.density, look.rgb, points=points)
        self.centre = seen.extra["points"].detach(), seen.opacity.detach()
        side = self.config.guidance.render_width
        rgba = torch.cat([seen.rgb, seen.opacity[:, None]], -1).reshape(len(batch), side, side, 4).movedim(-1, 1)
        return terms | self.guidance.terms(rgba, batch, step, generator)

    def after_step(self, step: int) -> None:
        super().after_step(step)
        if self.centre is not None:
            self.guidance.follow(*self.centre)

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return [*self.network.optimizers_at(self.config.learning_rate), *super().optimizers()]

    def learning_rate(self, step: int, progress: float) -> float:
        """Warm-up, then constant, then exponential decay."""
        c = self.config
        return hold_and_decay(c.learning_rate, FINAL_LEARNING_RATE, step, progress, DECAY_START)


def rays_of(views: PromptedViews) -> Rays:
    """Rays of all pixels, view by view."""
    pixels = views.camera[0].pixels()
    index = torch.arange(len(views), device=pixels.device).repeat_interleave(len(pixels))
    return views.camera.rays(pixels.repeat(len(views), 1), index)
