"""CloudMethod: base class of Gaussian splatting methods, trained on one photograph a step (Kerbl 2023)."""

from __future__ import annotations

import math
from abc import ABC
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ... import kernels
from ...camera import Camera
from ...camera.rays import Rendering
from ...color.blending import over
from ...datasets.scene import Frame, Photograph, Scene
from ...errors import LumigraphError
from ...files.ranges import CloudSize, Share, between
from ...gaussians import Gaussians
from ...gaussians.splatting import render, splat, view_of
from ...method import Method
from ...method.capabilities import ColourPairs
from ...method.depth import depth_layers, depth_terms
from ...system.plugins import taken
from ..fields.teacher import teacher_of
from ..training.dense_points import Points, compile_sweep, seen_points
from ..training.pose_refinement import PoseRefinement
from .adaptive import AdaptiveNumbers
from .addition import Addition, Step, TrainingViews
from .appearance import AppearanceNumbers, SplatAppearance
from .cloud import Cloud, HasteNumbers, picture_share, thinned
from .density_control import BYTES_PER_GAUSSIAN, DensityControl, RefineNumbers
from .error_density import pixel_errors
from .initialization import cloud_of, initial_cloud, may_sweep, random_cloud, surface_cloud
from .interval_schedule import intervals
from .moved_cloud import seen_from

BLACK = 0.0, 0.0, 0.0
SH_DEGREE_INTERVAL = 1000  # steps for each further degree of harmonics, section 7.1; or the share below, if sooner
SH_DEGREE_INTERVAL_SHARE = 1 / 8  # of the budget
SSIM_WEIGHT = 0.2  # share of D-SSIM in the loss, eq. 7
TRANSMITTANCE_THRESHOLD = 1e-4  # transmittance at which a pixel is finished, appendix C
SWEEP_SHARE = 0.08  # share of a budget of seconds that plane sweeps may take
NEAR_PLANE_SCALE = 0.1  # of the scene's near distance; Gaussians before the near plane get no gradient
LEAST_PIXELS = 4096  # of a photograph that is reduced
COARSE_UNTIL = 0.5  # share of the budget with plain colours, and by default half size, where poses are refined
PLACEHOLDER_COUNT = 1000  # random Gaussians before training at most
MAX_TEACHER_SHARE = 0.5  # of the cap, with which a cloud begins on the surfaces of a teacher


@dataclass(frozen=True)
class CloudNumbers:
    """Options of a cloud, those of 3D Gaussian Splatting."""

    sh_degree: Annotated[int, between(0, 3)] = 3  # degree of spherical harmonics, section 5.1; 0: no view dependence
    initial_gaussians: CloudSize = 100_000  # random Gaussians, where there are no points, section 7.1
    half_resolution_until: Share = 0.0  # share of the budget at half size, its first quarter at a quarter; faster
    rates: HasteNumbers = HasteNumbers()
    refine: RefineNumbers = RefineNumbers()
    adaptive: AdaptiveNumbers = AdaptiveNumbers()
    photographs: AppearanceNumbers = AppearanceNumbers()
    additions: tuple[str, ...] = ()  # of other packages, by the names of their entry points in lumigraph.additions


class CloudMethod(Method, ABC):
    """A cloud of Gaussians trained on one photograph a step; `density_control` changes their number.

    Assign a DensityControl as `density_control`, a PoseRefinement or None as `poses`, and further `Addition`s. The
    Config has `cloud: CloudNumbers`, `initialization` and `seed`.
    cameras:  of the training photographs; None before training
    bands:    of the harmonics in use
    current:  the step between `loss` and `after_step`
    drawn:    number of training photographs sampled so far
    """

    ssim_weight: float = SSIM_WEIGHT
    numbers: CloudNumbers
    density_control: DensityControl
    poses: PoseRefinement | None
    drawn: Tensor

    def __init__(self, frame: Frame, config: Any):
        c = config
        super().__init__(frame, c)
        n = self.numbers = c.cloud
        count = min(PLACEHOLDER_COUNT, n.refine.max_gaussians or PLACEHOLDER_COUNT)
        self.cloud = Cloud(random_cloud(frame, count, n.sh_degree, self.random(0)), most_haste=n.rates.most_haste)
        self.appearance = SplatAppearance(frame, n.photographs) if n.photographs.appearance != "no" else None
        self.register_buffer("drawn", torch.tensor(0))
        for name in n.additions:
            self.add_module(f"plugin_{name.replace('-', '_')}", addition_of(name, frame))
        self.cameras: Camera | None = None
        self.bands = n.sh_degree + 1
        self.current: Step | None = None

    @property
    def additions(self) -> list[Addition]:
        return [part for part in self.children() if isinstance(part, Addition)]

    @property
    def near_plane(self) -> float:
        """Near plane of rasterisation."""
        return NEAR_PLANE_SCALE * self.frame.near

    def growth_bytes(self) -> int:
        return BYTES_PER_GAUSSIAN * self.density_control.max_count(self.cloud, math.inf)

    # Initialisation

    def compile_begin(self) -> None:
        super().compile_begin()
        if may_sweep(self.config.initialization, self.frame):
            compile_sweep()

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        sweep = cache(partial(seen_points, data, SWEEP_SHARE * seconds))
        self.begin_with(self.first_cloud(data, sweep), data.cameras[data.splits["train"]])
        for part in self.additions:
            part.begin_scene(self.cloud, self.views, data, sweep)
        super().begin(data, seconds)

    def first_cloud(self, data: Scene, sweep: Callable[[], Points]) -> Gaussians:
        """Initial cloud from the photographs. sweep: returns points of plane sweeps"""
        c, cap = self.config, self.density_control.max_count(self.cloud)
        counts = min(c.cloud.initial_gaussians, cap), cap
        return initial_cloud(data, c.initialization, *counts, c.cloud.sh_degree, self.random(1), sweep)

    @torch.no_grad()
    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Initialise with Gaussians on the teacher's surfaces; a cloud is copied."""
        degree, cap = self.numbers.sh_degree, self.density_control.max_count(self.cloud)
        found = cloud_of(teacher, cap, degree)
        if found is None:
            count = max(2, math.ceil(MAX_TEACHER_SHARE * cap))
            found = surface_cloud(teacher_of(teacher, cameras), count, degree, self.random(3))
        self.begin_with(found, cameras)

    def begin_with(self, gaussians: Gaussians, cameras: Camera) -> None:
        """Initialise with a cloud, for training on photographs of these cameras."""
        self.cloud.replace(gaussians)
        self.cloud.set_extent(cameras)
        self.cameras = cameras
        for part in self.additions:
            part.begin_cloud(self.cloud, self.views, self.random(5))

    # Optimisation (section 5)

    def before_step(self, step: int, progress: float) -> None:
        """Add bands of harmonics one by one (section 7.1), but not while they would compensate wrong poses or depth."""
        super().before_step(step, progress)
        joined = intervals(step, progress, SH_DEGREE_INTERVAL, SH_DEGREE_INTERVAL_SHARE)
        coarse = self.moves_cameras and progress < COARSE_UNTIL
        plain = coarse or any(part.base_colours for part in self.additions)
        self.bands = 1 if plain else 1 + min(int(joined), self.numbers.sh_degree)

    def batch(self, data: Scene, generator: torch.Generator) -> Photograph:
        """The next photograph, in random order without repetition within an epoch."""
        if self.cameras is None:  # in a run that was resumed
            self.cameras = data.cameras[data.splits["train"]]
        train = self.joined_photographs(data)
        turn, place = divmod(int(self.drawn), len(train))
        self.drawn += 1
        order = torch.randperm(len(train), generator=self.random(1_000_000 + turn))
        layers = depth_layers(self.config, data) + tuple(x for part in self.additions for x in part.layers(data))
        photograph = data.photograph(int(train[order[place]]), layers)
        self.figures["reduction"] = times = self.reduction(*photograph.rgb.shape[:2])
        return photograph.reduced(times).to(self.device)

    def joined_photographs(self, data: Scene) -> Int[Tensor, " photograph"]:
        """Current training photographs; all by default."""
        return data.splits["train"]

    @property
    def least_pixels(self) -> int:
        """Least number of pixels of a downscaled photograph."""
        return LEAST_PIXELS

    def reduction(self, height: int, width: int) -> int:
        """Current downscaling factor of photographs of a size, in pixels."""
        half = self.numbers.half_resolution_until or COARSE_UNTIL * self.moves_cameras
        times = 4 if self.progress < half / 4 else 2 if self.progress < half else 1
        while times > 1 and height * width < self.least_pixels * times**2:
            times //= 2
        return times

    @property
    def views(self) -> TrainingViews:
        return TrainingViews(self.cameras, self.refined, self.near_plane, self.frame.near, self.moves_cameras)

    def moment_of(self, camera: Camera | None = None) -> float:
        """Moment of a camera, in a scene that moves."""
        return 0.0

    def step_on(self, photograph: Photograph, number: int) -> Step:
        """A step that begins, on a photograph."""
        cloud, moment = self.filtered(), self.moment_of(photograph.camera)
        return Step(
            photograph, self.random(~number), cloud, cloud, photograph.camera, self.cloud, self.views,
            number, self.random(number), self.progress, int(self.drawn), self.bands, moment,
            differ=self.appearance is not None and self.appearance.is_active,
            full_size=self.progress >= self.numbers.half_resolution_until)  # fmt: skip

    def loss(self, batch: Photograph, step: int) -> dict[str, Tensor]:
        """The absolute error and D-SSIM of a picture (eq. 7), and the terms of additions."""
        c, now = self.config, self.step_on(batch, step)
        self.current = now
        for part in self.additions:
            part.before_raster(now)
        if self.poses:
            now.cloud, now.camera = seen_from(self.poses, now.cloud, now.camera)
        if self.density_control.follows_errors(self.progress):
            now.explained = torch.zeros(len(now.cloud), device=self.device, requires_grad=True)
        view = view_of(now.camera, self.near_plane)
        now.picture = splat(now.cloud, view, self.bands, TRANSMITTANCE_THRESHOLD, numbers=now.explained)
        now.rgb, now.background = now.picture.rgb, self.background[0]
        if now.picture.centres.requires_grad:
            now.picture.centres.retain_grad()  # density control follows it
        if batch.alpha is not None:  # a random colour behind everything, so that only opacity can imitate opacity
            now.background = torch.rand(3, generator=now.chance).to(self.device)
        now.target = batch.before(now.background)
        for part in self.additions:
            part.after_raster(now)
        if now.background.any():
            now.rgb = over(now.rgb, now.picture.opacity, now.background)
        if batch.mask is not None:
            now.target = torch.where(batch.mask[..., None], now.target, now.rgb.detach())
        now.residual = (now.rgb - now.target).detach()
        for part in self.additions:
            part.mask(now)
        ssim, l1 = kernels.photometric(now.rgb, now.target)
        now.terms |= {"l1": (1 - self.ssim_weight) * l1, "ssim": self.ssim_weight * (1 - ssim)}
        if now.explained is not None:  # zero, with the gradient that density control follows
            now.terms["l1"] = now.terms["l1"] + (now.picture.number * pixel_errors(now)).sum()
        if batch.extra:
            now.terms |= depth_terms(c, batch.extra, now.picture.along_rays(now.camera), now.picture.opacity)
        for part in self.additions:
            part.regularize(now)
        return now.terms

    @torch.no_grad()
    def after_step(self, step: int) -> None:
        now = self.current
        assert now is not None and now.picture.centres.grad is not None
        now.due = self.density_control.due(step, self.progress)
        if now.camera.image_index is not None:
            self.cloud.record_view(now.camera.image_index, now.picture.centres.grad.ne(0).any(-1))
        for part in self.additions:
            part.finish(now)
            self.follow_rebuilds()
        super().after_step(step)
        self.figures |= {"mse": float(now.residual.square().mean()), "gaussians": len(self.cloud)}
        self.current = None

    @torch.no_grad()
    def prune(self, keep: Bool[Tensor, " gaussian"]) -> None:
        """Keep the Gaussians of a mask, with their moments in the optimizer."""
        self.cloud.prune(keep)
        self.follow_rebuilds()

    def follow_rebuilds(self) -> None:
        """Make all additions follow the changes of the cloud since the last call."""
        if (source := self.cloud.source) is not None:
            self.cloud.source = None
            for part in self.additions:
                part.follow(source)

    # Rendering (section 6)

    def filtered(self) -> Gaussians:
        """The cloud with filters, without a photograph's appearance."""
        cloud = self.cloud.gaussians()
        for part in self.additions:
            cloud = part.filtered(cloud)
        return cloud

    def gaussians(self) -> Gaussians:
        """The cloud in the scene's frame, under the settings."""
        cloud = self.filtered()
        for part in self.additions:
            cloud = part.recoloured_cloud(self, cloud)
        return cloud

    def rasterized(self, camera: Camera) -> Rendering:
        """Rendering over black, without a photograph's appearance."""
        return render(self.filtered(), camera, BLACK, self.near_plane)

    def render(self, camera: Camera) -> Rendering:
        camera = camera.to(self.device)
        return self.apply_settings(self.rasterized(camera), camera)

    def apply_settings(self, seen: Rendering, camera: Camera) -> Rendering:
        """A rendering over black in the appearance of the settings, and the background."""
        background = self.background[0]
        for part in self.additions:
            rgb, background = part.apply_appearance(self, seen, camera, background)
            seen = replace(seen, rgb=rgb)
        return replace(seen, rgb=over(seen.rgb, seen.opacity, background)) if background.any() else seen

    def colour_pairs(self, photograph: Photograph) -> ColourPairs:
        """Rendered colours as a function of a photograph's pose at all of its trusted pixels; see `RefinesPoses`."""
        photograph, cloud = photograph.to(self.device), self.filtered()
        target = photograph.trusted(photograph.before(self.background[0]))

        def pairs(poses: Any, generator: torch.Generator) -> tuple[Float[Tensor, "pixel 3"], Float[Tensor, "pixel 3"]]:
            moved, camera = seen_from(poses, cloud, photograph.camera)
            picture = splat(moved, view_of(camera, self.near_plane))
            seen = self.apply_settings(Rendering(picture.rgb, picture.depth, picture.opacity), camera)
            return photograph.trusted(seen.rgb), target

        return pairs

    # Compression

    def importance(self, camera: Camera) -> dict[str, Float[Tensor, " row"]]:
        """Derivative of one picture's brightness with respect to each Gaussian's."""
        return {"cloud.harmonics": picture_share(self.gaussians(), camera.to(self.device), self.near_plane)}

    @torch.no_grad()
    def thin(self, importance: dict[str, Float[Tensor, " row"]], share: float) -> dict[str, Float[Tensor, " kept"]]:
        """Remove the least important Gaussians."""
        weights = importance["cloud.harmonics"]
        cloud, kept = thinned(self.cloud.gaussians(), weights, share)
        self.cloud.replace(cloud)
        for part in self.additions:
            part.follow(kept)
        return {"cloud.harmonics": weights[kept]}


def addition_of(name: str, frame: Frame) -> Addition:
    """Addition of another package. Raises LumigraphError where none has the name, and for what is no Addition."""
    made = taken("additions", name)(frame)
    if not isinstance(made, Addition):
        raise LumigraphError(
            f"{name} makes a {type(made).__name__}; derive it from lumigraph.components.clouds.Addition"
        )
    return made
