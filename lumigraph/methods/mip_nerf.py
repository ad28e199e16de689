"""Mip-NeRF: pixels see cones, and what is smaller than a cone's width fades (Barron et al. 2021, arXiv 2103.13415)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from ..camera import Camera
from ..components.fields.coordinate_field import FrustumField, NetworkNumbers
from ..components.fields.spaces import space_of
from ..components.fields.teacher import POINTS_PER_RAY, distil, teacher_of
from ..components.sampling.cone_sampler import ConeSampler
from ..components.sampling.hierarchical_sampler import CPU_NETWORK, TINY_NETWORK, RayNumbers
from ..components.sampling.occupancy import MaskNumbers
from ..components.sampling.samplers import sampling_bytes
from ..components.training.pose_refinement import PoseNumbers, poses_for
from ..components.training.schedules import BandSchedule, exponential_decay, joining_of
from ..datasets.scene import Frame
from ..files.ranges import LearningRate, NonNegative, Share, Width, changed
from ..method import BaseConfig, FieldMethod
from ..method.depth import DepthNumbers


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers, with where it gives them; then numbers that save time and keep the mathematics."""

    network: NetworkNumbers = NetworkNumbers(position_frequencies=16)  # section 4: with cones, more do no harm
    rays: RayNumbers = RayNumbers(128, 128)  # section 3.2
    mask: MaskNumbers = MaskNumbers()
    poses: PoseNumbers = PoseNumbers()
    measured: DepthNumbers = DepthNumbers()
    hidden_width: Width = 256  # channels of a layer, as NeRF's; wider holds more detail, and costs time
    coarse_to_fine: Share = 0.0  # share of the budget in which octaves are added (Yang 2023, eq. 2); 0: at once
    coarse_loss_weight: NonNegative = 0.1  # lambda, weight of the coarse colours, section 3.2; 0: it only guides
    learning_rate: LearningRate = 5e-4  # Adam's learning rate at first, section 4; higher: faster, may diverge
    final_learning_rate: LearningRate = 5e-6  # learning rate at the end of the budget, section 4
    warmup: Share = 0.0025  # share of the budget in which the learning rate rises, section 4; 0: none


SOURCES = {  # of the numbers of `paper`; the others are ours
    "google/mipnerf, internal/models.py (84c969e)": (
        "depth position_frequencies direction_frequencies hidden_width coarse_samples fine_samples resample_padding"
    ),
    "google/mipnerf, internal/utils.py (84c969e)": (
        "rays_per_step coarse_loss_weight learning_rate final_learning_rate warmup"
    ),
    "google/mipnerf, internal/models.py (84c969e), which has no such step": "occupancy_resolution",
}


class MipNeRF(FieldMethod):
    """One network, evaluated twice on frustums of cones: evenly at first, then where density was found."""

    Config, further_bytes, learning_rate = Config, staticmethod(sampling_bytes), exponential_decay
    network: FrustumField
    sampler: ConeSampler

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        space = space_of(frame)
        self.poses = poses_for(frame, c.poses)
        self.bands = BandSchedule(c.coarse_to_fine) if c.coarse_to_fine else None
        self.network = FrustumField(c.network, c.hidden_width, space, joining=joining_of(self.poses, self.bands))
        self.sampler = ConeSampler(space, c.rays, c.mask, c.coarse_loss_weight > 0)

    @classmethod
    def cpu_preset(cls) -> Any:
        """A smaller network, evaluated where something is."""
        return changed(Config(**CPU_NETWORK), depth=6, skip_layer=3)

    @classmethod
    def smallest(cls) -> Any:
        """The paper's network, tiny, and a grid of what is empty: every part, within some twenty quick steps."""
        return changed(Config(**TINY_NETWORK), depth=3, skip_layer=2, position_frequencies=6)

    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """The network, taught at points by the teacher."""
        known, c, chance = teacher_of(teacher, cameras), self.config, self.random(3)
        if self.bands:
            self.bands.joined.fill_(1.0)  # the teacher's field has its details
        self.sampler.begin_from(known, chance)
        optimizer = torch.optim.Adam(self.network.parameters(), c.learning_rate)
        points = POINTS_PER_RAY * c.rays.rays_per_step
        distil(self.network, known, self.network.space, [optimizer], points, chance, self.device)

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return [torch.optim.Adam(self.network.parameters(), self.config.learning_rate), *super().optimizers()]
