"""HumanNeRF: a person before one camera, as a canonical field under skeletal and non-rigid motion (Weng 2022)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...camera.rays import Rays
from ...components.backbone import CPU_BACKBONE, TINY_BACKBONE, BackboneNumbers
from ...components.fields.hash_field import HashNumbers
from ...components.fields.spaces import Box
from ...components.sampling.occupancy_sampler import StepNumbers
from ...components.sampling.samplers import sampling_bytes
from ...components.skinning.articulated import Articulated
from ...components.skinning.bone_motion import BoneMotion, BoneNumbers
from ...components.skinning.weight_volume import WeightNumbers, WeightVolume
from ...components.training.photometric import backdrop
from ...components.training.schedules import held_decay
from ...datasets.scene import Batch, Frame
from ...files.ranges import changed
from ...method import BaseConfig, FieldMethod, Pass, seeded
from ...method.field import Colours, Densities, Directions, Points
from ...method.sampler import Density
from ...volume import composite
from .fields import NonRigidNumbers, NonRigidOffset, PosedField

PROBED_MOMENTS = 8  # at which an update of the occupancy grid asks for density


@dataclass(frozen=True)
class Config(BaseConfig):
    """Numbers of the release for ZJU-MoCap, chungyiweng/humannerf, configs/default.yaml."""

    backbone: BackboneNumbers = BackboneNumbers(
        table=HashNumbers(sh_bands=1), steps=StepNumbers(256), final_learning_rate=5e-4 * 0.1**0.8
    )
    bones: BoneNumbers = BoneNumbers()
    weights: WeightNumbers = WeightNumbers()
    nonrigid: NonRigidNumbers = NonRigidNumbers()


SOURCES = {  # of the numbers of `paper`; the others are ours
    "chungyiweng/humannerf, configs/default.yaml (7389c40)": (
        "hidden_width depth position_frequencies learning_rate final_learning_rate weight_cells weight_code weights_lr "
        "pose_correction pose_depth pose_width pose_lr pose_from nonrigid_depth nonrigid_width nonrigid_frequencies "
        "nonrigid_from nonrigid_until nonrigid_lr"
    ),
}


class HumanNeRF(Articulated, FieldMethod):
    """A canonical field, and the deformation from a posed body to it."""

    Config, further_bytes, learning_rate = Config, staticmethod(sampling_bytes), held_decay
    network: PosedField

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        space = Box(frame.bounds, frame.near)
        with seeded(c.seed):
            self.bones = BoneMotion(frame, c.bones)
            canonical = c.backbone.build(frame, space)
            offset = NonRigidOffset(self.bones.given_angles.shape[1], c.nonrigid)
            self.network = PosedField(canonical, WeightVolume(frame, c.weights), offset)
        self.sampler = c.backbone.sampler(frame, space)

    @classmethod
    def cpu_preset(cls) -> Any:
        """A hash table as canonical field, a learnt volume of weights, a small offset, and higher rates."""
        return changed(changed(Config(), **CPU_BACKBONE), sh_bands=1, samples_per_step=1 << 13, occupancy_resolution=64,
            learning_rate=1e-2, weight_cells=24, weight_code=0, weights_lr=1e-2, pose_correction="table", pose_lr=2e-3,
            pose_from=0.1, pose_smoothing=True, nonrigid_depth=2, nonrigid_width=32, nonrigid_skip=1,
            nonrigid_frequencies=4, nonrigid_from=0.3, nonrigid_until=0.7, nonrigid_lr=1e-3)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """A tiny table under tiny motions within some twenty quick steps."""
        return changed(changed(Config(), **TINY_BACKBONE), samples_per_step=1024, weight_cells=8, weight_code=4,
            weights_lr=1e-2, bone_radius=0.2, pose_lr=1e-3, pose_from=0.0, nonrigid_depth=2,
            nonrigid_width=8, nonrigid_skip=1, nonrigid_frequencies=2, nonrigid_from=0.0, nonrigid_until=0.5,
            nonrigid_lr=1e-3)  # fmt: skip

    # Moments

    def posed(self, times: Float[Tensor, " moment"]) -> PosedField:
        """The field in the poses of moments, under the settings."""
        turns, places = self.bones.pose_joints(self.settings, times)
        return self.network.posed(self.bones.transforms(turns, places), self.bones.angles_of(turns.detach()))

    def passes(self, rays: Rays, generator: torch.Generator | None = None) -> list[Pass]:
        times, rows = self.moments(rays).unique(return_inverse=True)
        return self.sampler.sample(rays, self.posed(times), rows[:, None].float(), generator)

    def shown_field(self) -> PosedField:
        """The field in the pose of renderings, by the settings."""
        return self.posed(torch.tensor([self.moment_of()], device=self.device))

    def field(self, points: Points, directions: Directions) -> tuple[Densities, Colours]:
        return self.shown_field()(points, directions)

    def density(self, points: Points) -> Densities:
        return self.shown_field().density(points)

    def density_in_training(self, generator: torch.Generator) -> Density:
        """Density of each point at one of some random moments of the capture."""
        moments = self.bones.times[torch.randint(len(self.bones.times), (PROBED_MOMENTS,), generator=generator)]

        @torch.no_grad()
        def density(points: Points) -> Densities:
            rows = torch.randint(len(moments), (len(points), 1), generator=generator).to(self.device).float()
            return self.posed(moments.to(self.device)).density(points, rows)

        return density

    # Learning

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """The squared error of colours before random backgrounds, without LPIPS (section 3.4)."""
        generator = self.random(step)
        (samples,), terms = self.learn(batch.rays, generator)
        background = backdrop(batch, self.background, generator, opaque=False)
        look = samples.look(self.network)
        seen = composite(look.samples, look.density, look.rgb, background)
        error = (seen.rgb - batch.before(background)).square().mean()
        self.figures["mse"] = float(error.detach())
        return {"colour": error, **terms}

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return [*self.config.backbone.optimizers(self.network.canonical), *super().optimizers()]
