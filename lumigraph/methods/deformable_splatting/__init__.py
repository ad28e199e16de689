"""Deformable splatting: a cloud of Gaussians that moves through planes of space and time (Wu et al. 2024)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from ...camera import Camera
from ...camera.rays import Rendering
from ...components.clouds.adaptive import AdaptiveDensity
from ...components.clouds.appearance import AppearanceNumbers
from ...components.clouds.cloud_method import BLACK, CloudMethod, CloudNumbers
from ...components.clouds.initialization import Initialization
from ...components.clouds.tidying import ALL_RULES, Tidying, TidyingNumbers
from ...datasets.scene import Frame, Scene
from ...files.ranges import Share, changed
from ...gaussians import Gaussians
from ...gaussians.moving import MovingGaussians, fitted
from ...gaussians.splatting import render
from ...geometry import to_matrix
from ...method import BaseConfig, seeded
from ...method.controls import Control, moment
from .planes import MotionNumbers, PlaneMotion

MIN_SPAN = 0.1  # share of the time with which training begins, where moments join
FOLLOWED = 4  # Gaussians that a point of a surface moves with
MIN_FOLLOWED_OPACITY = 0.1  # of these Gaussians


@dataclass(frozen=True)
class Config(BaseConfig):
    """The numbers of the authors' release, with Kerbl's (2023) of the cloud."""

    cloud: CloudNumbers = CloudNumbers(initial_gaussians=2000, photographs=AppearanceNumbers(appearance="no"))
    ssim_weight: Share = 0.0  # share of D-SSIM in the loss; higher gives structure more weight
    initialization: Initialization = "sparse"  # first Gaussians: sparse points, plane sweeps' points too, or random
    motion: MotionNumbers = MotionNumbers()
    tidying: TidyingNumbers = TidyingNumbers()


SOURCES = {  # of the numbers of `paper`; the others are ours
    "hustvl/4DGaussians, arguments/dnerf/dnerf_default.py (843d5ac)": (
        "plane_scales motion_width still_until plane_smoothness time_smoothness time_sparsity planes_lr motion_lr "
        "final_rate"
    ),
    "hustvl/4DGaussians, arguments/__init__.py (843d5ac)": (
        "ssim_weight plane_resolution plane_moments plane_features"
    ),
    "hustvl/4DGaussians, scene/dataset_readers.py (843d5ac)": "initial_gaussians",
    "hustvl/4DGaussians, scene/deformation.py (843d5ac), which has no such part": "nodes all_moments_from rigidity",
}


class DeformableSplatting(CloudMethod):
    """A canonical cloud, moved to the moment of a photograph before it is rasterized."""

    Config = Config

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        count = len(self.cloud)
        self.poses, self.ssim_weight = None, c.ssim_weight
        self.density_control = AdaptiveDensity(c.cloud.refine, c.cloud.adaptive, count)
        with seeded(c.seed):
            self.motion = PlaneMotion(frame, c.motion, count)  # it follows what density control does to the cloud
        self.tidying = Tidying(c.tidying)

    @classmethod
    def cpu_preset(cls) -> Any:
        """A smaller cloud that begins dense, carried by nodes, coarser planes, and higher rates for few steps."""
        return changed(Config(tidying=ALL_RULES), initialization="dense", max_gaussians=40_000, cap_ramp=True,
            initial_gaussians=10_000, ssim_weight=0.2, sh_degree=1, most_haste=4.0, half_resolution_until=0.4,
            plane_resolution=32, plane_features=8, plane_moments=32, nodes=400, rigidity=0.01, still_until=0.08,
            planes_lr=4e-3, motion_lr=1e-3, final_rate=0.1)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """Some hundred Gaussians that move, are refined and told apart within some twenty quick steps."""
        return changed(
            Config(tidying=ALL_RULES), max_gaussians=300, cap_ramp=True, refine_until=0.8, sh_degree=1,
            initial_gaussians=200, ssim_weight=0.2, densify_grad_threshold=1e-6, opacity_reset_interval=5,
            plane_resolution=4, plane_moments=4, plane_features=4, nodes=20, rigidity=0.01, all_moments_from=0.3,
            still_until=0.0,
        )  # fmt: skip

    def joined_photographs(self, data: Scene) -> Int[Tensor, " photograph"]:
        """Photographs around the middle time at first, and gradually all others (`all_moments_from`)."""
        train, until = super().joined_photographs(data), self.config.motion.all_moments_from
        times, share = data.cameras.time, self.progress / until if until else 1.0
        if times is None or self.frame.times is None or share >= 1:
            return train
        first, last = self.frame.times
        away = (times[train] - (first + last) / 2).abs()
        reach = (MIN_SPAN + (1 - MIN_SPAN) * share) * (last - first) / 2
        return train[away <= torch.maximum(away.new_tensor(reach), away.min())]

    @property
    def controls(self) -> tuple[Control, ...]:
        return (*super().controls, moment(self.frame.times)) if self.frame.times else super().controls

    def moment_of(self, camera: Camera | None = None) -> float:
        """The shown moment: of the settings, else of the camera, else the first."""
        if "time" not in self.settings and camera is not None and camera.time is not None:
            return float(camera.time[0])
        first, _ = self.frame.times or (0.0, 0.0)
        return float(self.settings.get("time", first))

    def gaussians(self) -> Gaussians:
        return self.motion.at(super().gaussians(), self.moment_of())

    @torch.no_grad()
    def moving(self, duration: float) -> MovingGaussians:
        """The cloud with its motion, in the colours of the settings, played in so many seconds."""
        first, last = self.frame.times or (0.0, 1.0)
        cloud = super().gaussians()
        return fitted(lambda share: self.motion.at(cloud, first + share * (last - first)), duration)

    def rasterized(self, camera: Camera) -> Rendering:
        cloud = self.motion.at(self.filtered(), self.moment_of(camera))
        return render(cloud, camera, BLACK, self.near_plane)

    @torch.no_grad()
    def follow(self, points: Float[Tensor, "point 3"], start: float, end: float) -> Float[Tensor, "point 3"]:
        """Positions at one moment of surface points of another: they move rigidly with the Gaussians around them."""
        canonical = self.filtered()
        solid = canonical.opacities.sigmoid() > MIN_FOLLOWED_OPACITY
        if not solid.any():
            return points
        before, after = (self.motion.at(canonical, time)[solid] for time in (start, end))
        count = min(FOLLOWED, len(before))
        away, nearest = cKDTree(before.means.cpu().numpy()).query(points.cpu().numpy(), count)
        away, chosen = (np.reshape(x, (len(points), count)) for x in (away, nearest))
        rows = torch.from_numpy(chosen).to(points.device)
        weight = 1 / (torch.from_numpy(away).to(points) ** 2 + 1e-8)
        turns = to_matrix(after.quaternions) @ to_matrix(before.quaternions).mT
        there = (turns[rows] @ (points[:, None] - before.means[rows])[..., None])[..., 0] + after.means[rows]
        return (weight[..., None] * there).sum(1) / weight.sum(1, keepdim=True)
