"""Articulated splatting: Gaussians that bones move with learnt weights (MANUS, Pokhariya et al. 2024)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import torch
from jaxtyping import Int
from torch import Tensor

from ...camera import Camera
from ...camera.rays import Rendering
from ...components.clouds.adaptive import AdaptiveDensity
from ...components.clouds.appearance import AppearanceNumbers
from ...components.clouds.cloud_method import BLACK, CloudMethod, CloudNumbers
from ...components.clouds.initialization import Initialization, round_gaussians
from ...components.clouds.tidying import Tidying, TidyingNumbers
from ...components.skinning.articulated import Articulated
from ...components.skinning.bone_motion import BoneNumbers
from ...components.skinning.weight_volume import WeightNumbers
from ...datasets.scene import Frame, Photograph, Scene
from ...files.ranges import PositiveShare, changed
from ...gaussians import Gaussians
from ...gaussians.moving import MovingGaussians, fitted
from ...gaussians.splatting import render
from ...method import BaseConfig, seeded
from ...method.controls import Control
from .contact import PICTURE, bodies_of, contact_control, contact_map
from .skinned_cloud import SkinnedCloud

PRUNE_NEAR, LIMIT_SCALE, LIMIT_ANISOTROPY, OBSERVED_HARMONICS = False, False, True, False  # rules of tidying
MAX_RATIO = 4.0  # of the longest to the shortest deviation, above which the isotropy term acts
ISOTROPY_WEIGHT = 0.01  # weight of long Gaussians, which tear at joints
INITIALIZATION: Initialization = "random"  # an option of older runs; first Gaussians are about the bones


@dataclass(frozen=True)
class Config(BaseConfig):
    """Kerbl's (2023) numbers of the cloud, as in MANUS; those of bones and weights are ours, not the paper's."""

    cloud: CloudNumbers = CloudNumbers(initial_gaussians=10_000, photographs=AppearanceNumbers(appearance="no"))
    initialization: ClassVar[Initialization] = INITIALIZATION
    contact_distance: PositiveShare = 0.02  # gap in scene units up to which two bodies touch in a map of contact
    bones: BoneNumbers = BoneNumbers(pose_correction="table", pose_lr=1e-2, pose_from=0.1)
    weights: WeightNumbers = WeightNumbers(weight_code=0, weights_lr=1e-2)


SOURCES = {  # of the numbers of `paper`; the others are ours
    "brown-ivl/manus, config/model/gaussian/gaussian.yaml (4c981ad)": (
        "sh_degree ssim_weight densify_grad_threshold refine_every"
    ),
}


class ArticulatedSplatting(Articulated, CloudMethod):
    """A canonical cloud on bones, posed to the moment of a photograph before it is rasterized."""

    Config = Config

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        self.poses = None
        self.density_control = AdaptiveDensity(c.cloud.refine, c.cloud.adaptive, len(self.cloud))
        with seeded(c.seed):
            self.skin = SkinnedCloud(frame, c.bones, c.weights)
        self.bones = self.skin.bones
        self.tidying = Tidying(TidyingNumbers(PRUNE_NEAR, LIMIT_SCALE, LIMIT_ANISOTROPY, OBSERVED_HARMONICS))

    @classmethod
    def cpu_preset(cls) -> Any:
        """A smaller cloud without view dependence, a coarser volume, and higher rates for few steps."""
        return changed(Config(), sh_degree=0, initial_gaussians=6000, max_gaussians=30_000, cap_ramp=True,
            half_resolution_until=0.3, most_haste=4.0, weight_cells=24, pose_smoothing=True)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """Some hundred Gaussians on bones, refined within some twenty quick steps."""
        return changed(Config(), max_gaussians=300, cap_ramp=True, refine_until=0.8, sh_degree=1, initial_gaussians=200,
            densify_grad_threshold=1e-6, opacity_reset_interval=5, weight_cells=8, bone_radius=0.5, pose_lr=1e-3,
            pose_from=0.0)  # fmt: skip

    def first_cloud(self, data: Scene, sweep: Any) -> Gaussians:
        """Round Gaussians about the bones at rest, in random colours."""
        generator, cap = self.random(1), self.density_control.max_count(self.cloud)
        means = self.skin.first_means(min(self.numbers.initial_gaussians, cap), generator)
        return round_gaussians(means, torch.rand(len(means), 3, generator=generator), self.numbers.sh_degree)

    def loss(self, batch: Photograph, step: int) -> dict[str, Tensor]:
        """The cloud's terms, and the isotropy of its Gaussians: the mean excess of their ratios of deviations."""
        terms = super().loss(batch, step)
        ratio = (self.cloud.log_scales.amax(-1) - self.cloud.log_scales.amin(-1)).exp()
        return terms | {"isotropy": ISOTROPY_WEIGHT * (ratio - MAX_RATIO).clamp_min(0).mean()}

    @property
    def controls(self) -> tuple[Control, ...]:
        several = len(set(bodies_of(self.bones.skeleton.parents).tolist())) > 1
        return (*super().controls, *((contact_control(),) if several else ()))

    def body_of(self, canonical: Gaussians) -> Int[Tensor, " gaussian"]:
        """Number of the body, a tree of bones, that each Gaussian of the canonical cloud moves with."""
        trees = torch.from_numpy(bodies_of(self.bones.skeleton.parents)).to(self.device)
        shares = self.skin.weights(canonical.means)
        return shares.new_zeros(len(shares), int(trees.max()) + 1).index_add(1, trees, shares).argmax(1)

    def at(self, canonical: Gaussians, time: float) -> Gaussians:
        """A canonical cloud at a moment under the settings, as a picture or a map of contact."""
        cloud = self.skin.at(self.settings, canonical, time)
        if self.settings.get("show", PICTURE) == PICTURE:
            return cloud
        return contact_map(cloud, self.body_of(canonical), self.config.contact_distance)

    def gaussians(self) -> Gaussians:
        return self.at(super().gaussians(), self.moment_of())

    @torch.no_grad()
    def moving(self, duration: float) -> MovingGaussians:
        """The cloud with its motion, of the capture or of the poses of the settings, played in so many seconds."""
        first, last = self.frame.times or (0.0, 1.0)
        at = partial(self.at, super().gaussians())
        return fitted(lambda share: at(first + share * (last - first)), duration)

    @torch.no_grad()
    def rasterized(self, camera: Camera) -> Rendering:
        cloud = self.at(self.filtered(), self.moment_of(camera))
        return render(cloud, camera, BLACK, self.near_plane)
