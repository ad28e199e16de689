"""3D Gaussian Splatting: a scene as a cloud of soft, coloured ellipsoids (Kerbl et al. 2023, arXiv 2308.04079)."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from .. import kernels
from ..camera import Camera
from ..camera.rays import Rendering
from ..color.blending import over
from ..components.clouds.at_surfaces import at_surfaces, of_cloud
from ..components.clouds.cloud import Cloud, CloudAdam
from ..components.clouds.dense_points import compile_sweep
from ..components.clouds.density_control import AdaptiveDensity, MarkovChain
from ..components.clouds.few_photographs import LEFT_OUT, some_left_out, unseen_roughness
from ..components.clouds.initial_cloud import Initialization, initial_cloud, random_cloud
from ..components.clouds.seen_from import seen_from
from ..components.clouds.smoothing import sampling_interval, smoothed
from ..components.clouds.tidying import before_a_lens, confined, nearest_camera
from ..components.clouds.witnesses import hold_back
from ..components.fields import own_sky
from ..components.fields.affine_colours import NUMBERS, changed, changed_harmonics, found
from ..components.fields.appearance import PhotographCodes
from ..components.fields.taken_over import taken_over
from ..components.training.lights import spread_of_light
from ..components.training.pose_refinement import PoseRefinement
from ..components.training.rhythm import Rhythm, haste, intervals
from ..components.training.schedules import falling
from ..components.training.trimming import Trimming
from ..datasets.scene import Frame, Photograph, Scene
from ..errors import LumigraphWarning
from ..exchange.morton import morton_order
from ..exchange.packing import Stored, most_important
from ..files.ranges import CloudSize, LearningRate, NonNegative, PositiveShare, Seed, Share, Steps, between
from ..gaussians import Gaussians
from ..gaussians.splatting import Splatted, render, splat, view_of
from ..method import Method
from ..method.controls import Control, Value
from ..system.memory import room_for


@dataclass(frozen=True)
class Config:
    """The paper's numbers, with where it gives them; those without a section are the authors' release's."""

    sh_degree: Annotated[int, between(0, 3)] = 3  # of the spherical harmonics, section 5.1
    sh_degree_interval: Steps = 1000  # steps, section 7.1; or the share below of the budget, if that is sooner
    sh_degree_interval_share: PositiveShare = 1 / 8
    ssim_weight: Share = 0.2  # share of D-SSIM in the loss, eq. 7
    strategy: Literal["adaptive", "mcmc"] = "adaptive"  # density control: section 5, or Kheradmand 2024
    max_gaussians: CloudSize = 1_000_000  # cap of the cloud's size, under either strategy
    initialization: Initialization = "sparse"  # points of structure from motion, "dense" with plane sweeps' beside them
    initial_gaussians: CloudSize = 100_000  # at random places, where nothing else is known, section 7.1
    half_resolution_until: Share = 0.0  # share of the budget at half size; the first quarter of it at a quarter
    refine_every: Steps = 100  # steps between changes of the cloud, section 5.2; or the share, if that is sooner
    refine_every_share: PositiveShare = 0.1
    refine_from: Steps = 500  # step; or the share of the budget, if that is sooner
    refine_from_share: PositiveShare = 0.15
    refine_until: Share = 0.5  # share of the budget; section 7.1: 15 000 of 30 000 steps
    joining_per_step: NonNegative = 0.0  # Gaussians that mcmc has added by each step, if 5 % a change would be fewer
    densify_grad_threshold: NonNegative = 2e-4  # gradient of a centre that asks for more Gaussians, section 5.2
    opacity_reset_interval: Steps = 3000  # steps, section 5.2
    means_lr: LearningRate = 1.6e-4  # times the extent of the cameras
    final_means_lr: LearningRate = 1.6e-6
    sh_lr: LearningRate = 2.5e-3  # a twentieth of it beyond the first band
    opacities_lr: LearningRate = 0.05
    scales_lr: LearningRate = 5e-3
    quaternions_lr: LearningRate = 1e-3
    most_haste: Annotated[float, between(1, 1000)] = 1.0  # times the rates of scales and harmonics, in short runs
    opacity_regularization: NonNegative = 0.01  # of the mean opacity in the loss, for mcmc (Kheradmand 2024, eq. 11)
    scale_regularization: NonNegative = 0.01  # of the mean deviation, in extents, for mcmc
    transmittance_threshold: Share = 1e-4  # at which a pixel is finished, appendix C
    antialiased: bool = False  # Mip-Splatting's 2-D filter (Yu 2024, section 5.2)
    filter_3d: bool = False  # Mip-Splatting's 3-D filter (Yu 2024, section 5.1)
    refine_cameras: bool = False  # learn where each photograph was taken from, small pictures first
    pose_learning_rate: LearningRate = 5e-3  # radians by which a step moves a picture, with refine_cameras
    match_photographs: bool = True  # with refine_cameras, begin where features that photographs share say
    appearance: Literal["auto", "yes", "no"] = "auto"  # learn how each photograph's colours differ; auto: where they do
    own_skies: bool = True  # and in the open what shows behind everything, for each photograph
    appearance_lr: LearningRate = 5e-3  # of those changes of colour
    final_appearance_lr: LearningRate = 5e-4
    appearance_regularization: NonNegative = 1e-3  # of a change's squared numbers in the loss
    robust: Literal["auto", "yes", "no"] = "auto"  # leave out what moved; auto: where colours differ
    robust_start: Share = 0.1  # share of the budget before which every pixel counts
    few_views: bool = False  # leave Gaussians out at random, smooth depth where nobody was, plain colours
    depth_weight: NonNegative = 1.0  # of the roughness of depth in pictures that nobody took, with few_views
    seed: Seed = 0


STORAGE = {  # of tensors, where a run is compressed; positions need the most bits
    "cloud.means": Stored("scaled", 16),
    "cloud.quaternions": Stored("scaled"),
    "cloud.log_scales": Stored("scaled"),
    "cloud.opacities": Stored("scaled"),
    "cloud.harmonics": Stored("coded", plain=3),
    "cloud.marks": Stored("nothing"),
    "density_control.pulls": Stored("nothing"),
    "density_control.sightings": Stored("nothing"),
}
SWEEPING = 0.08  # of the budget: the share that looking for points to begin at may take
BLACK = 0.0, 0.0, 0.0
STOPS = 0.3  # between neighbouring photographs, beyond which they are of different light
NEAR = 0.1  # times the scene's near distance: the near plane of splats
COARSE = 0.5  # of the budget: where poses are refined, plain colours, and half size if nothing else is said
SMALLEST = 64  # pixels of a photograph's shorter side that are kept when it is reduced
ENOUGH = 2400  # steps, with which sizes and colours need not hurry
OFTEN = 400  # times that each photograph is learnt from, with which its light need not hurry
MOST_HASTE = 6.0  # times the rate at which photographs' light is learnt, in short runs
RECOVERY = 3  # opacity_reset_intervals that must be left after opacities are reset, or the pictures stay dim
GROWTH = 1.05  # of the number at each change, for mcmc (Kheradmand 2024, section 3.2)
LAST_MOVE = 0.9  # share of the budget after which mcmc moves and adds no Gaussians, so that those there converge
TAKEN = 0.5  # of max_gaussians: how many a cloud begins with at most, on the surfaces of another method
BYTES = 4096  # that one more Gaussian needs while it learns: itself, its gradient and moments, its share of a picture


class GaussianSplatting(Method):
    """A cloud of Gaussians that learns from one photograph a step; `density_control` changes their number."""

    Config = Config
    grows: ClassVar[tuple[str, ...]] = ("interval",)
    extent: Tensor
    drawn: Tensor
    differ: Tensor
    began: Tensor
    interval: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        placeholder = random_cloud(frame, min(1000, config.max_gaussians), config.sh_degree, self.random(0))
        self.cloud = Cloud(placeholder)
        self.cloud.antialiased = config.antialiased
        self.density_control = AdaptiveDensity(len(self.cloud), config.densify_grad_threshold)
        self.exploration = MarkovChain()
        refining, rate = config.refine_cameras, config.pose_learning_rate
        self.poses = PoseRefinement(frame.image_count, rate) if refining else None
        photographs, told_apart = frame.image_count, config.appearance != "no"
        self.skies = config.own_skies and frame.reach > 1 and not frame.has_alpha
        numbers = NUMBERS + own_sky.NUMBERS * self.skies
        self.lights: PhotographCodes | None = PhotographCodes(photographs, numbers) if told_apart else None
        self.found: Tensor | None = None  # the light of a photograph that was given
        self.trimming = Trimming() if config.robust != "no" else None
        self.rhythm = Rhythm(config.refine_every, config.refine_every_share)
        self.register_buffer("extent", torch.tensor(1.0))
        self.register_buffer("drawn", torch.tensor(0))
        self.register_buffer("differ", torch.tensor(config.appearance == "yes"), persistent=told_apart)
        self.register_buffer("began", torch.tensor(len(self.cloud)))
        self.register_buffer("interval", torch.zeros(len(self.cloud) if config.filter_3d else 0))
        self._bands = config.sh_degree + 1
        self._progress = 1.0  # as trained; `before_step` says how far training is
        self._cameras: Camera | None = None
        self._told_full = False
        self._optimizer: CloudAdam | None = None
        self._seen: Splatted | None = None
        self._image = 0  # that was learnt from last
        self._difference = torch.zeros(0)

    @property
    def _near(self) -> float:
        """The near plane of splats, well before the scene's: what lies before it gets no gradient to remove it."""
        return NEAR * self.frame.near

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """On a GPU the paper's numbers; on a CPU a smaller cloud that begins dense: it learns more in the time."""
        if device.type == "cuda":
            return Config()
        return Config(
            initialization="dense",
            max_gaussians=120_000,
            initial_gaussians=20_000,
            half_resolution_until=0.7,
            joining_per_step=120.0,
            most_haste=4.0,
        )

    @classmethod
    def smallest(cls) -> Any:
        """Some hundred Gaussians that are refined, reset and given harmonics within some twenty quick steps."""
        return Config(
            sh_degree=2,
            sh_degree_interval=4,
            max_gaussians=300,
            initial_gaussians=200,
            refine_every=4,
            refine_from=4,
            refine_until=0.8,
            densify_grad_threshold=1e-6,
            opacity_reset_interval=5,
            refine_cameras=True,
            appearance="no",
        )

    def rehearse_begin(self) -> None:
        if self.config.initialization == "dense":
            compile_sweep()

    @torch.no_grad()
    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Gaussians on the teacher's surfaces; a cloud is taken as it is."""
        config, most = self.config, max(2, math.ceil(TAKEN * self._most()))
        found = of_cloud(teacher, self._most(), config.sh_degree)
        if found is None:
            found = at_surfaces(taken_over(teacher, cameras), most, config.sh_degree, self.random(3))
        self._begin_with(found, cameras)

    def begin(self, scene: Scene, seconds: float = math.inf) -> None:
        config = self.config
        counts = min(config.initial_gaussians, self._most()), self._most()
        sweeping = SWEEPING * seconds
        found = initial_cloud(scene, config.initialization, *counts, config.sh_degree, self.random(1), sweeping)
        self._begin_with(found, scene.cameras[scene.splits["train"]])
        self._tell_apart(scene)
        if self.poses:
            self.poses.find(scene, self.config.match_photographs)

    def _begin_with(self, found: Gaussians, cameras: Camera) -> None:
        """A first cloud, and what follows from the cameras that it will be learnt by."""
        self.cloud.replace(found, self._optimizer)
        self.density_control.begin(len(found))
        self.began.fill_(len(found))
        self._cameras = cameras
        if self.config.filter_3d:
            self.interval = sampling_interval(self.cloud.means, cameras, self._near)
        positions = cameras.position
        self.extent.fill_(1.1 * float((positions - positions.mean(0)).norm(dim=-1).max()))

    def batch(self, scene: Scene, generator: torch.Generator) -> Photograph:
        """The next photograph: each once in a random order, then in another."""
        train = scene.splits["train"]
        if self._cameras is None:  # in a run that was resumed
            self._cameras = scene.cameras[train]
        turn, place = divmod(int(self.drawn), len(train))
        self.drawn += 1
        order = torch.randperm(len(train), generator=self.random(1_000_000 + turn))
        self._image = int(train[order[place]])
        photograph = scene.photograph(self._image)
        return photograph.reduced(self._reduction(min(photograph.rgb.shape[:2]))).to(self.device)

    def _reduction(self, shorter: int) -> int:
        """How many times smaller photographs are at this share of the budget; no side gets below SMALLEST pixels."""
        half = self.config.half_resolution_until or (COARSE if self.poses else 0.0)
        wanted = 4 if self._progress < half / 4 else 2 if self._progress < half else 1
        return max(1, min(wanted, shorter // SMALLEST))

    def loss(self, batch: Photograph, step: int) -> dict[str, Tensor]:
        config, camera = self.config, batch.camera
        whole = cloud = self._cloud()
        chance = self.random(~step)
        if config.few_views:
            cloud = some_left_out(cloud, LEFT_OUT * self._progress, chance)
        if self.poses:
            cloud, camera = seen_from(self.poses, cloud, camera)
        seen = splat(cloud, view_of(camera, self._near), self._bands, config.transmittance_threshold)
        rgb, background = seen.rgb, torch.tensor(self.frame.background, device=seen.rgb.device)
        if batch.alpha is not None:  # a random colour behind everything, so that only opacity can imitate opacity
            background = torch.rand(3, generator=chance).to(rgb.device)
        target = batch.before(background)
        code, terms = None, {}
        if self.appearance and camera.image_index is not None:
            code = self.appearance(camera.image_index)[0]
            rgb = changed(rgb, seen.opacity, code)
            if self.skies:
                background = own_sky.sky(code[NUMBERS:], batch.camera)
                terms["sky"] = own_sky.backdrop_loss(background, batch, seen.opacity)
        if background.any():
            rgb = over(rgb, seen.opacity, background)
        if batch.mask is not None:
            target = torch.where(batch.mask[..., None], target, rgb.detach())
        if seen.centres.requires_grad:
            seen.centres.retain_grad()
        self._seen = seen
        self._difference = (rgb - target).detach()
        if self._trimming and self._progress >= config.robust_start:
            counted = self._trimming(self._difference.abs().mean(-1))
            target = torch.where(counted[..., None], target, rgb.detach())
        difference = rgb - target
        terms |= {
            "l1": (1 - config.ssim_weight) * difference.abs().mean(),
            "ssim": config.ssim_weight * (1 - kernels.ssim(rgb, target)),
        }
        if code is not None:
            terms["appearance"] = config.appearance_regularization * code[:NUMBERS].square().sum()
        if config.few_views and config.depth_weight and self._cameras is not None:
            terms["depth"] = config.depth_weight * unseen_roughness(whole, self._cameras, self._near, chance)
        if config.strategy == "mcmc":
            terms["opacity"] = config.opacity_regularization * whole.opacities.sigmoid().mean()
            terms["scale"] = config.scale_regularization / float(self.extent) * whole.log_scales.exp().mean()
        return terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c, cloud = self.config, self.cloud
        columns = [1.0] * 3 + [1 / 20] * (3 * (c.sh_degree + 1) ** 2 - 3)
        groups = [
            {"name": "means", "params": [cloud.means], "lr": c.means_lr},
            {"params": [cloud.quaternions], "lr": c.quaternions_lr},
            {"name": "scales", "params": [cloud.log_scales], "lr": c.scales_lr},
            {"params": [cloud.opacities], "lr": c.opacities_lr},
            {"name": "harmonics", "params": [cloud.harmonics], "lr": c.sh_lr, "columns": columns},
        ]
        if self.lights:  # one row a step has a gradient, as with Gaussians
            groups.append({"name": "appearance", "params": [self.lights.codes], "lr": c.appearance_lr})
        self._optimizer = CloudAdam(groups)
        return [self._optimizer, self.poses.optimizer()] if self.poses else [self._optimizer]

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        """Exponential decay of the means' rate (section 7.1), in extents of the cameras; the others stay. Sizes and
        colours hurry where there are few steps."""
        c = self.config
        times = haste(step, progress, ENOUGH, c.most_haste)
        means = float(self.extent) * falling(c.means_lr, c.final_means_lr, progress)
        rates = {"means": means, "scales": times * c.scales_lr, "harmonics": times * c.sh_lr}
        if self.lights:
            hurry = haste(step, progress, OFTEN * self.frame.image_count, MOST_HASTE)
            rates["appearance"] = hurry * falling(c.appearance_lr, c.final_appearance_lr, progress)
        return rates | ({"poses": self.poses.rate(progress)} if self.poses else {})

    def before_step(self, step: int, progress: float) -> None:
        config, self._progress = self.config, progress
        if self.poses:
            self.poses.progress.fill_(progress)
        raised = intervals(step, progress, config.sh_degree_interval, config.sh_degree_interval_share)
        # Colours by direction would explain wrong poses away, and with few photographs wrong depth.
        flat = config.few_views or (self.poses is not None and progress < COARSE)
        self._bands = 1 if flat else 1 + min(int(raised), config.sh_degree)

    @torch.no_grad()
    def after_step(self, step: int) -> None:
        config, seen, optimizer = self.config, self._seen, self._optimizer
        assert seen is not None and optimizer is not None
        self._seen, size = None, len(self.cloud)
        due = self.due(step)
        assert seen.centres.grad is not None and self._cameras is not None
        self.cloud.see(self._image, seen.centres.grad.ne(0).any(-1))
        if self._trimming:
            self._trimming.note(self._difference.abs().mean(-1))
        if config.strategy == "mcmc":
            self._sample(step, due, optimizer, self.random(step))
        elif self._progress < config.refine_until:
            self._densify(step, due, seen, optimizer)
        if due:
            self._tidy(self._cameras)
        if self._bands > 1:
            hold_back(self.cloud.harmonics, self.cloud.seen_by)
        if config.filter_3d and (due or len(self.cloud) != size):
            self.interval = sampling_interval(self.cloud.means, self._cameras, self._near)

    def due(self, step: int) -> bool:
        """Whether the cloud may change after this step."""
        first, share = self.config.refine_from, self.config.refine_from_share
        return self.rhythm.due(step, self._progress) and intervals(step, self._progress, first, share) >= 1

    def _densify(self, step: int, due: bool, seen: Splatted, optimizer: CloudAdam) -> None:
        height, width = seen.opacity.shape
        assert seen.centres.grad is not None
        control = self.density_control
        control.note(seen.centres.grad, seen.opacities > 0, (width, height))
        if due:
            most, chance = self._most_by_now(), self.random(step)
            wanted_more = control.refine(self.cloud, optimizer, float(self.extent), most, chance)
            if wanted_more and len(self.cloud) >= 0.99 * self._most():
                self._tell_full()
        every, whole = self.config.opacity_reset_interval, self._progress >= self.config.half_resolution_until
        if step and step % every == 0 and whole and step / max(self._progress, 1e-6) - step >= RECOVERY * every:
            control.reset_opacity(self.cloud, optimizer)

    def _tidy(self, cameras: Camera) -> None:
        """Leave nothing before a lens once each photograph was seen twice, and neither giants nor needles anywhere."""
        distance = nearest_camera(self.cloud.means, self.refined(cameras).position.to(self.device))
        hanging = before_a_lens(distance, self.cloud.seen_by, self.frame.near)
        if int(self.drawn) >= 2 * len(cameras) and hanging.any() and not hanging.all():
            self._leave(~hanging)
            distance = distance[~hanging]
        self.cloud.log_scales.copy_(confined(self.cloud.gaussians(), distance, float(self.extent)))

    def _sample(self, step: int, due: bool, optimizer: CloudAdam, chance: torch.Generator) -> None:
        if due and self._progress < LAST_MOVE:
            count = len(self.cloud)
            wanted = count
            if self._progress < self.config.refine_until:
                wanted = int(max(GROWTH * count, int(self.began) + step * self.config.joining_per_step))
            if wanted > max(most := self._most(), count) and most < self.config.max_gaussians:
                self._tell_full()
            self.exploration.refine(self.cloud, optimizer, min(wanted, max(most, count)), chance)
        self.exploration.explore(self.cloud, optimizer.param_groups[0]["lr"], chance)

    def _most(self) -> int:
        """The cap on the number of Gaussians: `max_gaussians`, or what the memory at hand allows."""
        return min(self.config.max_gaussians, len(self.cloud) + room_for(BYTES, self.device))

    def _most_by_now(self) -> int:
        """The cap at this share of the budget: it rises evenly until `refine_until`, so that early steps are quick."""
        began, most = int(self.began), self._most()
        share = min(1.0, self._progress / self.config.refine_until)
        return min(most, int(began + share * max(most - began, 0)))

    def _tell_full(self) -> None:
        """Warn, once, that the cloud has reached its cap."""
        if not self._told_full:
            self._told_full = True
            told = len(self.cloud) >= 0.95 * self.config.max_gaussians
            why = "--max-gaussians says so" if told else "memory is short"
            warnings.warn(f"The cloud stops growing at {len(self.cloud):,} Gaussians, for {why}", LumigraphWarning, 2)

    @torch.no_grad()
    def prune(self, keep: Bool[Tensor, " gaussian"]) -> None:
        """Leave those Gaussians that a mask picks, with their moments in the optimizer."""
        self._leave(keep)
        if self.config.filter_3d:
            self.interval = self.interval[keep]

    def _leave(self, keep: Bool[Tensor, " gaussian"]) -> None:
        assert self._optimizer is not None
        source = keep.nonzero()[:, 0]
        self.cloud.rebuild(self._optimizer, source, torch.zeros_like(source, dtype=torch.bool))
        if self.config.strategy == "adaptive":  # the chain counts no gradients
            self.density_control.prune(keep)

    def storage(self) -> dict[str, Stored]:
        """Harmonics beyond the plain colour by a codebook; of what density control counts, nothing."""
        return STORAGE

    def importance(self, camera: Camera) -> dict[str, Float[Tensor, " row"]]:
        """How much each Gaussian adds to one picture: what the picture gains where it alone gets brighter."""
        cloud = self.gaussians()
        grey = torch.zeros(len(cloud), 1, 3, device=self.device, requires_grad=True)
        with torch.enable_grad():
            seen = splat(replace(cloud, harmonics=grey), view_of(camera.to(self.device), self._near), 1)
            (gain,) = torch.autograd.grad(seen.rgb.sum(), grey)
        return {"cloud.harmonics": gain[:, 0].mean(-1)}

    @torch.no_grad()
    def thin(self, importance: dict[str, Float[Tensor, " row"]], share: float) -> dict[str, Float[Tensor, " kept"]]:
        """Leave the least important Gaussians out; the others lie along Morton's curve, where neighbours are alike."""
        weights, cloud = importance["cloud.harmonics"], self.cloud.gaussians()
        kept = most_important(weights, 1 - share).nonzero()[:, 0]
        kept = kept[torch.from_numpy(morton_order(cloud.means[kept].detach().cpu().numpy()))]
        upright = nn.functional.normalize(cloud.quaternions, dim=-1)
        upright = torch.where(upright[:, :1] < 0, -upright, upright)  # the same rotations, which fewer numbers say
        self.cloud.replace(replace(cloud, quaternions=upright)[kept])
        self.density_control.begin(len(kept))
        if self.config.filter_3d:
            self.interval = self.interval[kept]
        return {"cloud.harmonics": weights[kept]}

    def gaussians(self) -> Gaussians:
        """The cloud, in the scene's frame and the light that was told, with the 3-D filter where that is used."""
        cloud, code = self._cloud(), self._light
        return cloud if code is None else replace(cloud, harmonics=changed_harmonics(cloud.harmonics, code))

    def _cloud(self) -> Gaussians:
        """The cloud as it is learnt, which is in no photograph's light."""
        cloud = self.cloud.gaussians()
        return smoothed(cloud, self.interval) if self.config.filter_3d else cloud

    def refined(self, cameras: Camera) -> Camera:
        return self.poses.refined(cameras) if self.poses else cameras

    def render(self, camera: Camera) -> Rendering:
        camera = camera.to(self.device)
        seen, code = render(self._cloud(), camera, BLACK, self._near), self._light
        if code is None:
            return replace(seen, rgb=over(seen.rgb, seen.opacity, self.background[0]))
        rgb = changed(seen.rgb, seen.opacity, code.detach()).clamp(0, 1)
        behind = own_sky.sky(code.detach()[NUMBERS:], camera).clamp(0, 1) if self.skies else self.background[0]
        return replace(seen, rgb=over(rgb, seen.opacity, behind))

    # Photographs that differ

    @property
    def appearance(self) -> PhotographCodes | None:
        """How each photograph's colours differ; None where they do not, or may not be told apart."""
        return self.lights if bool(self.differ) else None

    @property
    def _trimming(self) -> Trimming | None:
        return self.trimming if self.config.robust == "yes" or bool(self.differ) else None

    def _tell_apart(self, scene: Scene) -> None:
        """Find out whether photographs differ so much that each has to be seen in a light of its own."""
        if self.config.appearance == "auto":
            stops = spread_of_light(scene) or 0.0
            self.differ.fill_(stops > STOPS)
        if self.appearance and self.skies:
            with torch.no_grad():
                self.appearance.codes[:, NUMBERS:] = own_sky.mean_skies(scene).to(self.device)
        if self.config.appearance == "auto" and bool(self.differ):
            warnings.warn(
                f"Neighbouring photographs differ by {stops:.1f} stops, so each has colours of its own, and what moved "
                "between them is left out; `--appearance no` takes all for the same light",
                LumigraphWarning,
                stacklevel=2,
            )

    @property
    def accepts(self) -> tuple[type, ...]:  # type: ignore[override]  # it depends on the run
        """Photographs, where their colours were learnt to differ."""
        return (Photograph,) if self.appearance else ()

    @property
    def controls(self) -> tuple[Control, ...]:
        about = (
            "The photograph, by number or name, in whose light and colours the scene is shown; or the average of all."
        )
        return (self.appearance.control("appearance", about),) if self.appearance else ()

    def given(self, *evidence: Any, **controls: Value) -> Method:
        """The same cloud, told its controls, or in the light of a photograph, found from the pixels that are to be
        trusted."""
        photographs = [piece for piece in evidence if self.appearance and isinstance(piece, Photograph)]
        others = (piece for piece in evidence if not (self.appearance and isinstance(piece, Photograph)))
        told = super().given(*others, **controls)
        assert isinstance(told, GaussianSplatting)
        for photograph in photographs:
            told.found = self._found(photograph)
            told.told.pop("appearance", None)
        return told

    @property
    def _light(self) -> Float[Tensor, " number"] | None:
        """The code that was told, else the one that was found, else the average; None where there are none."""
        if self.appearance is None:
            return None
        if self.found is not None and "appearance" not in self.told:
            return self.found
        return self.appearance.told(str(self.control("appearance")))

    @torch.no_grad()
    def _found(self, photograph: Photograph) -> Float[Tensor, " number"]:
        """The light in which the cloud looks most like a photograph; the average, where no pixel tells."""
        assert self.appearance is not None
        photograph, background = photograph.to(self.device), self.background[0]
        camera = photograph.camera
        seen = render(self._cloud(), camera, BLACK, self._near)
        target, trusted = photograph.before(background), photograph.mask
        if trusted is None:
            trusted = torch.ones_like(seen.opacity, dtype=torch.bool)
        behind = own_sky.harmonics(camera)[trusted] if self.skies else None
        if behind is None:
            target = target - (1 - seen.opacity[..., None]) * background
        start = self.appearance.average.detach()
        return found(start, seen.rgb[trusted], seen.opacity[trusted], target[trusted], behind)

    def statistics(self) -> dict[str, float]:
        return {"mse": float(self._difference.square().mean()), "gaussians": len(self.cloud)}
