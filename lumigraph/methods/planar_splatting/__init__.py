"""Planar splatting: surfaces from photographs by flat Gaussians (PGSR, Chen et al. 2024, arXiv 2406.06521).

Each Gaussian is flattened into a disc, whose plane gives unbiased depth and a normal (2DGS, Huang et al. 2024, arXiv
2403.17888, has discs as well). Planes agree with the depth of their own view, and with the photographs of other views.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch

from ...camera import Camera
from ...camera.rays import Rendering
from ...components.clouds.adaptive import AdaptiveDensity
from ...components.clouds.addition import Addition, Step, TrainingViews
from ...components.clouds.cloud import Cloud
from ...components.clouds.cloud_method import TRANSMITTANCE_THRESHOLD, CloudMethod, CloudNumbers
from ...components.clouds.initialization import Initialization
from ...components.clouds.tidying import ALL_RULES, Tidying, TidyingNumbers
from ...components.training.pose_refinement import PoseNumbers, poses_for
from ...datasets.scene import Frame, Photograph, Scene
from ...errors import LumigraphError
from ...files.ranges import BatchSize, NonNegative, Share, between, changed
from ...gaussians.splatting import splat, view_of
from ...geometry import unit
from ...method import BaseConfig
from ...method.depth import DepthNumbers
from ...system.work import at_work
from .consistency import (
    DISC_EDGE_POWER,
    EDGE_POWER,
    PlaneView,
    grey_of,
    multi_view_errors,
    near_views,
    patch_centres,
    single_view_error,
)
from .planes import discs, plane_maps

STOPS = {"mean": 1e-4, "median": 0.5}  # transmittance at which the planes of a pixel are finished
FLATNESS_WEIGHT = 100.0  # lambda_1, weight of the smallest scales; higher: flatter Gaussians
NEAR_VIEWS = 8  # nearest photographs, of which a step draws the other view

POSE_LEARNING_RATE = 5e-3  # radians that a step moves a picture at most


@dataclass(frozen=True)
class PlaneNumbers:
    """A Config's numbers of planes."""

    depth: Literal["mean", "median"] = "mean"  # planes of all Gaussians on a ray, or none behind the median one
    normal_weight: NonNegative = 0.015  # lambda_2, weight of depth-normal consistency; higher: smoother surfaces
    photometric_weight: NonNegative = 0.15  # lambda_3, weight of 1 - NCC between views; 0: photographs one by one
    geometric_weight: NonNegative = 0.03  # lambda_4, weight of reprojection errors in pixels
    consistency_from: Share = 7000 / 30_000  # share of the budget before consistency counts
    patches: BatchSize = 102_400  # pixels of a step that are compared with another view; fewer are faster
    patch_side: Annotated[int, between(3, 31)] = 7  # pixels along a patch, an odd number
    view_angle: Annotated[float, between(1, 180)] = 30.0  # degrees between the axes of two views, at most
    both_views: bool = True  # move the other view's planes too; off: its picture needs no backward pass, faster
    discs: bool = False  # begin as discs across the points' normals; off: as balls

    @property
    def stop(self) -> float:
        """Transmittance at which the planes of a pixel terminate."""
        return STOPS[self.depth]


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers, those of 3D Gaussian Splatting where it gives none."""

    cloud: CloudNumbers = CloudNumbers()
    initialization: Initialization = "sparse"  # first Gaussians: sparse points, plane sweeps' points too, or random
    planes: PlaneNumbers = PlaneNumbers()
    poses: PoseNumbers = PoseNumbers()
    measured: DepthNumbers = DepthNumbers()
    tidying: TidyingNumbers = TidyingNumbers()

    def check(self) -> None:
        """Raises LumigraphError for patches without a middle."""
        if self.planes.patch_side % 2 == 0:
            raise LumigraphError(f"Patches of {self.planes.patch_side} pixels have no middle; give an odd --patch-side")


SOURCES = {  # of the numbers of `paper`; the others are ours
    "zju3dv/PGSR, arguments/__init__.py (de24f1a)": (
        "flatness_weight normal_weight photometric_weight geometric_weight consistency_from patches patch_side "
        "near_views view_angle sh_degree ssim_weight means_lr final_means_lr sh_lr opacities_lr scales_lr "
        "quaternions_lr refine_every refine_from refine_until densify_grad_threshold opacity_reset_interval"
    ),
    "zju3dv/PGSR, train.py (de24f1a)": "edge_power depth both_views sh_degree_interval initialization",
    "zju3dv/PGSR, train.py (de24f1a), which has no such step": (
        "discs half_resolution_until most_haste max_gaussians cap_ramp prune_near limit_scale limit_anisotropy "
        "observed_harmonics"
    ),
}


@dataclass(frozen=True)
class Pair(Photograph):
    """A photograph and a neighbouring one.

    other: None without a near camera
    """

    other: Photograph | None = None


class Planes(Addition):
    """Terms of the loss that flatten Gaussians and make their planes consistent."""

    def __init__(self, numbers: PlaneNumbers):
        super().__init__()
        self.numbers = numbers

    def begin_scene(self, cloud: Cloud, views: TrainingViews, data: Scene, sweep: Any) -> None:
        if self.numbers.discs:
            cloud.replace(discs(cloud.gaussians()))

    def regularize(self, step: Step) -> None:
        """lambda_1 L_s, and lambda_2 to lambda_4 times the consistency terms."""
        c, cloud = self.numbers, step.cloud
        visible = step.picture.opacities > 0
        step.terms["flatness"] = FLATNESS_WEIGHT * cloud.log_scales[visible].amin(-1).exp().mean()
        if step.progress < c.consistency_from:
            return
        here = PlaneView(step.camera, grey_of(step.photograph), plane_maps(cloud, step.picture, step.camera, c.stop))
        step.terms["normals"] = c.normal_weight * single_view_error(here, DISC_EDGE_POWER if c.discs else EDGE_POWER)
        other = step.photograph.other if isinstance(step.photograph, Pair) else None
        if other is None or not (c.photometric_weight or c.geometric_weight):
            return
        camera = step.views.refined(other.camera)
        with torch.set_grad_enabled(c.both_views):
            picture = splat(step.whole, view_of(camera, step.views.near_plane), 1, TRANSMITTANCE_THRESHOLD)
            there = PlaneView(camera, grey_of(other), plane_maps(step.whole, picture, camera, c.stop))
        middle = patch_centres(step.photograph, here.maps, c.patch_side, c.patches, step.chance)
        photometric, geometric = multi_view_errors(here, there, *middle, c.patch_side, not c.discs)
        step.terms["photometric"] = c.photometric_weight * photometric
        step.terms["geometric"] = c.geometric_weight * geometric


class PlanarSplatting(CloudMethod):
    """A cloud of discs that renders the depth and the normals of their planes."""

    Config = Config

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        self.planes = Planes(c.planes)
        self.density_control = AdaptiveDensity(c.cloud.refine, c.cloud.adaptive, len(self.cloud))
        self.tidying = Tidying(c.tidying)
        self.poses = poses_for(frame, c.poses, POSE_LEARNING_RATE)

    @classmethod
    def cpu_preset(cls) -> Any:
        """A smaller cloud that begins as discs on dense points. Consistency counts from early on and for more. Patches
        are fewer, and smaller because photographs are."""
        return changed(Config(tidying=ALL_RULES), initialization="dense", initial_gaussians=20_000,
            half_resolution_until=0.3, depth="median", normal_weight=0.05, photometric_weight=0.6, geometric_weight=0.1,
            consistency_from=0.05, patches=2048, patch_side=5, both_views=False, discs=True, max_gaussians=60_000,
            cap_ramp=True, most_haste=4.0)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """Some hundred Gaussians that are refined, reset and made consistent within some twenty quick steps."""
        return changed(Config(tidying=ALL_RULES), sh_degree=1, initial_gaussians=200, depth="median",
            consistency_from=0.1, patches=64, patch_side=3, view_angle=180.0, max_gaussians=300, cap_ramp=True,
            refine_until=0.8, densify_grad_threshold=1e-6, opacity_reset_interval=5, appearance="no")  # fmt: skip

    def batch(self, data: Scene, generator: torch.Generator) -> Photograph:
        """The next photograph and a neighbouring one."""
        c, seen, train = self.config.planes, super().batch(data, generator), data.splits["train"]
        assert self.cameras is not None and seen.camera.image_index is not None
        index = int((train == seen.camera.image_index.cpu()).nonzero()[0, 0])
        near = near_views(self.cameras, index, NEAR_VIEWS, c.view_angle)
        other = None
        if len(near):
            chosen = near[int(torch.randint(len(near), (1,), generator=generator))]
            other = data.photograph(int(train[chosen])).reduced(int(self.figures["reduction"])).to(self.device)
        return Pair(seen.camera, seen.rgb, seen.alpha, seen.mask, seen.extra, other)

    @at_work()
    @torch.no_grad()
    def rasterized(self, camera: Camera) -> Rendering:
        """Rendering over black, in no photograph's appearance, with unbiased depth and unit normals."""
        cloud = self.filtered()
        picture = splat(cloud, view_of(camera, self.near_plane))
        maps = plane_maps(cloud, picture, camera, self.config.planes.stop)
        depth = torch.where(picture.opacity > 1e-3, maps.depth, torch.inf)
        return Rendering(picture.rgb, depth, picture.opacity, {"normals": unit(maps.normals)})
