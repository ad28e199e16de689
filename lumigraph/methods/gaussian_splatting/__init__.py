"""3D Gaussian Splatting: a scene as a cloud of soft, coloured ellipsoids (Kerbl et al. 2023, arXiv 2308.04079)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from ...camera import Camera
from ...camera.rays import Rendering
from ...components.clouds.adaptive import AdaptiveDensity
from ...components.clouds.cloud_method import BLACK, CloudMethod, CloudNumbers
from ...components.clouds.error_density import ErrorDensity
from ...components.clouds.initialization import Initialization
from ...components.clouds.tidying import ALL_RULES, Tidying, TidyingNumbers
from ...components.instances import edit_of
from ...components.training.pose_refinement import PoseNumbers, poses_for
from ...datasets.scene import Frame
from ...errors import LumigraphError
from ...files.ranges import changed
from ...gaussians.splatting import render
from ...method import BaseConfig
from ...method.depth import DepthNumbers
from .few_views import FewViewNumbers, FewViews
from .instances import Identities, InstanceNumbers
from .mcmc import MarkovChain, McmcNumbers
from .mip_filter import MipFilter, MipNumbers
from .robust_mask import RobustMask, RobustNumbers

LEAST_PIXELS = 45_000  # of a reduced photograph; with fewer, Gaussians take most of a step's time anyway
# Codes that one pass of the rasteriser composites, learnt once the geometry is there.
CPU_GROUPS = InstanceNumbers(
    identity_code=8, identity_lr=0.05, classifier_lr=0.02, identity_interval=2, identity_start=0.4
)

POSE_LEARNING_RATE = 5e-3  # radians that a step moves a picture at most


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers, with where it gives them; those without a section are the authors' release's."""

    cloud: CloudNumbers = CloudNumbers()
    initialization: Initialization = "sparse"  # first Gaussians: sparse points, plane sweeps' points too, or random
    strategy: Literal["adaptive", "error", "mcmc"] = "adaptive"  # density control: section 5, by error, or MCMC
    mcmc: McmcNumbers = McmcNumbers()
    filters: MipNumbers = MipNumbers()
    poses: PoseNumbers = PoseNumbers()
    measured: DepthNumbers = DepthNumbers()
    distractors: RobustNumbers = RobustNumbers()
    sparse: FewViewNumbers = FewViewNumbers()
    tidying: TidyingNumbers = TidyingNumbers()
    groups: InstanceNumbers = InstanceNumbers()

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        refine = self.cloud.refine
        capped = refine.max_gaussians or (self.strategy == "error" and refine.gaussians_per_step)
        if self.strategy != "adaptive" and not capped:
            raise LumigraphError(f"With --strategy {self.strategy} a cloud grows up to its cap; give --max-gaussians")


SOURCES = {  # of the numbers of `paper`; the others are ours
    "graphdeco-inria/gaussian-splatting, arguments/__init__.py (82bc469)": (
        "sh_degree ssim_weight means_lr final_means_lr sh_lr opacities_lr scales_lr quaternions_lr refine_every "
        "refine_from refine_until densify_grad_threshold opacity_reset_interval"
    ),
    "graphdeco-inria/gaussian-splatting, train.py (82bc469)": "sh_degree_interval initialization strategy",
    "graphdeco-inria/gaussian-splatting, train.py (82bc469), which has no such step": (
        "half_resolution_until most_haste max_gaussians cap_ramp prune_near limit_scale limit_anisotropy "
        "observed_harmonics few_views antialiased filter_3d"
    ),
}


class GaussianSplatting(CloudMethod):
    """Gaussians with density control, and what laptops, few photographs, other light and moving things need beside."""

    Config = Config

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        self.cloud.antialiased, count = c.filters.antialiased, len(self.cloud)
        self.few_views = FewViews(c.sparse) if c.sparse.few_views != "no" else None
        if c.strategy == "mcmc":
            self.density_control = MarkovChain(c.cloud.refine, c.mcmc)
        else:
            kind = ErrorDensity if c.strategy == "error" else AdaptiveDensity
            self.density_control = kind(c.cloud.refine, c.cloud.adaptive, count)
        self.mip_filter = MipFilter(count) if c.filters.filter_3d else None
        self.tidying = Tidying(c.tidying)
        self.robust_mask = RobustMask(c.distractors) if c.distractors.robust != "no" else None
        self.identities = Identities(c.groups, count) if c.groups.objects == "yes" else None
        self.poses = poses_for(frame, c.poses, POSE_LEARNING_RATE)

    @property
    def least_pixels(self) -> int:
        return super().least_pixels if self.moves_cameras else LEAST_PIXELS

    def rasterized(self, camera: Camera) -> Rendering:
        if self.identities is None or edit_of(self) is None:
            return super().rasterized(camera)
        return render(self.identities.recoloured_cloud(self, self.filtered()), camera, BLACK, self.near_plane)

    @classmethod
    def cpu_preset(cls) -> Any:
        """A smaller cloud that begins dense: it learns more in the time."""
        return changed(Config(tidying=ALL_RULES, groups=CPU_GROUPS), initialization="dense", initial_gaussians=20_000,
            half_resolution_until=0.7, max_gaussians=500_000, gaussians_per_step=15.0, cap_ramp=True,
            strategy="error", refine_until=0.75, densify_grad_threshold=1e-4, joining_per_step=120.0, most_haste=4.0,
            few_views="auto")  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """Some hundred Gaussians that are refined, reset and given harmonics within some twenty quick steps."""
        return changed(Config(tidying=ALL_RULES), sh_degree=2, initial_gaussians=200, max_gaussians=300, cap_ramp=True,
            strategy="error", refine_until=0.8, opacity_reset_interval=5, refine_cameras=True,
            appearance="no")  # fmt: skip
