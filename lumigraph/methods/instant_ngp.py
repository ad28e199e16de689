"""Instant-NGP: a scene in a multiresolution hash table and two tiny networks (Müller et al. 2022, arXiv 2201.05989)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..components.fields.hash_field import HashField, HashNumbers
from ..components.fields.spaces import Box, space_of
from ..components.fields.teacher import distil, teacher_of
from ..components.sampling.importance import importance
from ..components.sampling.occupancy_sampler import OccupancyNumbers, StepNumbers
from ..components.sampling.samplers import CPU_HASH, TINY_HASH, ProposalNumbers, sampler_for, sampling_bytes
from ..components.training.photometric import Exposure, Setting, backdrop, huber, residuals
from ..components.training.pose_refinement import PoseNumbers, poses_for
from ..components.training.schedules import hold_and_decay
from ..datasets.scene import Batch, Frame
from ..exchange.packing import most_important
from ..files.ranges import LearningRate, NonNegative, PositiveShare, Width
from ..method import BaseConfig, FieldMethod, seeded
from ..method.depth import DepthNumbers, depth_terms
from ..volume import composite

FINAL_LEARNING_RATE = 1e-3  # learning rate at the end of the budget, reached exponentially
DECAY_START = 0.3  # share of the budget before the learning rate falls


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers, but for huber_delta and scenes without bounds; `InstantNGP.preset` has a plain CPU's."""

    table: HashNumbers = HashNumbers()
    occupancy: OccupancyNumbers = OccupancyNumbers()
    steps: StepNumbers = StepNumbers()
    proposals: ProposalNumbers = ProposalNumbers()
    poses: PoseNumbers = PoseNumbers()
    measured: DepthNumbers = DepthNumbers()
    hidden_width: Width = 64  # neurons of a hidden layer, section 5.4; wider costs time
    learning_rate: LearningRate = 1e-2  # Adam's learning rate at first, section 4; higher: faster, may diverge
    hash_weight_decay: NonNegative = 0.0  # decoupled weight decay of an object's table, towards a density of 1
    huber_delta: PositiveShare = 0.1  # residual at which the loss turns from squared to linear; 1: always squared
    contraction: bool = True  # contract open captures and sample by proposals (Barron 2022); off: cascades, 5.4
    exposure_correction: Setting = "auto"  # learn a gain per photograph; auto: where exposures are found to differ


SOURCES = {  # of the numbers of `paper`; the others are ours
    "Müller 2022, table 1": "levels features_per_level",
    "NVlabs/instant-ngp, configs/nerf/base.json (3612ea5)": (
        "log2_hashmap_size base_resolution density_layers colour_layers sh_bands hidden_width learning_rate"
    ),
    "Müller 2022, sections 4 and 5.4": "geometry_features huber_delta",
    "Müller 2022, appendix E": (
        "samples_per_step transmittance_threshold occupancy_resolution occupancy_interval occupancy_decay "
        "steps_per_diagonal"
    ),
}


class InstantNGP(FieldMethod):
    """A hash table sampled in occupied cells, or where proposals are in scenes without bounds."""

    Config, further_bytes = Config, staticmethod(sampling_bytes)
    network: HashField

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        space = space_of(frame) if c.contraction else Box(frame.bounds, frame.near)
        self.poses = poses_for(frame, c.poses)
        joining = self.poses.weights if self.poses else None
        with seeded(c.seed):
            self.network = HashField(c.table, c.hidden_width, space, frame.reach, joining=joining)
        self.sampler = sampler_for(frame, space, c.occupancy, c.proposals, steps=c.steps)
        learns_gains = c.exposure_correction != "no"
        self.exposure = Exposure(frame.image_count, c.exposure_correction) if learns_gains else None

    @classmethod
    def cpu_preset(cls) -> Any:
        """Half as many levels with twice the features, smaller tables and networks, a wider step, a smaller batch."""
        return Config(**CPU_HASH, hidden_width=32, learning_rate=2e-2, hash_weight_decay=0.3, huber_delta=0.3)

    @classmethod
    def smallest(cls) -> Any:
        """Tiny tables and networks with both corrections and a grid of three sizes, within some twenty quick steps."""
        poses = PoseNumbers(refine_cameras=True)
        return Config(**TINY_HASH, poses=poses, exposure_correction="yes", hidden_width=16, learning_rate=2e-2)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """The Huber loss of composited colours, before random backgrounds where rays need not end."""
        generator = self.random(step)
        (samples,), terms = self.learn(batch.rays, generator)
        look = samples.look(self.network)
        background = backdrop(batch, self.background, generator, opaque=self.sampler.is_open)
        rendering = composite(look.samples, look.density, look.rgb, background)
        residual, self.figures["mse"] = residuals(rendering, batch, background, self.exposure)
        terms |= depth_terms(self.config, batch.extra, rendering.depth, rendering.opacity)
        return {"huber": huber(residual, self.config.huber_delta), **terms}

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c = self.config
        return [*self.network.optimizers_at(c.learning_rate, c.hash_weight_decay), *super().optimizers()]

    def learning_rate(self, step: int, progress: float) -> float:
        """Twenty steps of warm-up, then constant, then exponential decay (section 4 decays likewise)."""
        c = self.config
        return hold_and_decay(c.learning_rate, FINAL_LEARNING_RATE, step, progress, DECAY_START)

    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Table and networks, taught at points by the teacher."""
        known, c, chance = teacher_of(teacher, cameras), self.config, self.random(3)
        optimizers = self.network.optimizers_at(c.learning_rate)
        points = c.occupancy.samples_per_step
        distil(self.field, known, self.network.space, optimizers, points, chance, self.device)
        self.sampler.begin_from(known, chance)
        self.sampler.settle(self.density, chance)

    def importance(self, camera: Camera) -> dict[str, Float[Tensor, " row"]]:
        """Weight of each entry of the table in one picture; see `components.sampling.importance`."""
        (shares,) = importance(self, camera, self.network.encode, [self.network.table])
        return {"network.table": shares.mean(-1)}

    @torch.no_grad()
    def thin(self, importance: dict[str, Float[Tensor, " row"]], share: float) -> dict[str, Float[Tensor, " kept"]]:
        """Set the least important entries of the table to zero."""
        self.network.table[~most_important(importance["network.table"], 1 - share)] = 0.0
        return importance
