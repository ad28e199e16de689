"""RegNeRF: few photographs, a scene smooth and likely between them (Niemeyer et al. 2022, arXiv 2112.00724).

Small patches of pictures that nobody took are rendered as well. Nothing is known of their colours; but depth that jumps
about, and patches such as no photograph has, say that the field explains each photograph by itself.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..camera.rays import Look, Rays, Rendering
from ..components.fields.hash_field import TABLE_ON_A_CPU, HashNumbers, check_levels
from ..components.training.fog import evened, thickness_before
from ..components.training.patch_flow import SIDE, PatchFlow
from ..components.training.photometric import backdrop, residuals
from ..components.training.unseen_views import patches, roughness, unseen_cameras
from ..datasets.scene import Batch, Frame, Scene
from ..files.ranges import LearningRate, NonNegative, PositiveShare, Share, Steps, Width, between
from ..method import RayMethod
from ..volume import composite
from .instant_ngp import Config as NgpConfig
from .instant_ngp import InstantNGP, huber
from .mip_nerf import Config as MipConfig
from .mip_nerf import MipNeRF


@dataclass(frozen=True)
class Config(HashNumbers, MipConfig):
    """The paper's numbers, with where it gives them, beside those of mip-NeRF's network, and Instant-NGP's of the hash
    table, which are explained there; `RegNeRF.preset` says what a plain CPU does otherwise."""

    field: Literal["network", "hash"] = "network"  # what is learnt: mip-NeRF's network, the paper's, or a hash table
    unseen_patches: Annotated[int, between(0, 4096)] = 64  # of 8 x 8 rays in a step; the paper has as many rays as seen
    depth_weight: NonNegative = 0.1  # of the roughness of depth in them, eq. 6
    depth_weight_start: NonNegative = 10.0  # what that weight falls from at first
    depth_settling: Share = 0.05  # share of the budget in which it falls
    likelihood_weight: NonNegative = 1e-3  # of how unlikely their colours are, eq. 8, in nats a number
    flow_steps: Steps = 400  # in which it is learnt, of 512 patches each, what is likely
    coarse_to_fine: Share = 0.0  # share of the budget in which finer octaves or levels join the coarsest; 0: at once
    occlusion_weight: NonNegative = 0.0  # of what stands right before cameras (Yang 2023, eq. 5)
    occlusion_range: Share = 0.1  # share of each ray that is right before its camera
    random_backdrop: bool = True  # the network learns open captures before random colours, as a table always does
    annealing: Share = 0.01  # share of the budget in which samples spread from the middle of rays, eq. 10
    annealing_start: PositiveShare = 0.5  # p_s, share of each ray that is sampled at first, eq. 10
    learning_rate: LearningRate = 2e-3
    final_learning_rate: LearningRate = 2e-5
    # Of the hash table and its networks.
    table_learning_rate: LearningRate = 1e-2
    final_table_learning_rate: LearningRate = 1e-3
    table_width: Width = 64  # neurons per hidden layer
    samples_per_step: Annotated[int, between(64, 1 << 24)] = 1 << 18
    steps_per_diagonal: Annotated[int, between(4, 16_384)] = 1024
    cone_angle: Share = 1 / 256
    transmittance_threshold: Share = 1e-4
    table_occupancy_threshold: NonNegative = 0.05
    hash_weight_decay: NonNegative = 0.0
    huber_delta: PositiveShare = 0.1
    sh_bands: Annotated[int, between(1, 4)] = 4
    sweep_weight: NonNegative = 0.03  # of what plane sweeps found in the open, at first; it falls to nothing

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        check_levels(self)

    def numbers_of(self, kind: type[Any]) -> Any:
        """The numbers of the field, as its own method has them: a `MipConfig` or an `NgpConfig`."""
        ours = {x.name: getattr(self, x.name) for x in fields(self)}
        if kind is NgpConfig:  # a table learns faster than a network, and asks smaller networks
            ours |= {name: ours[called] for name, called in OF_TABLE.items()}
        return kind(**{x.name: ours[x.name] for x in fields(kind) if x.name in ours})


OF_TABLE = {  # names of Instant-NGP's numbers, and what they are called beside a network's of the same name
    "learning_rate": "table_learning_rate",
    "final_learning_rate": "final_table_learning_rate",
    "hidden_width": "table_width",
    "occupancy_threshold": "table_occupancy_threshold",
    "depth_weight": "sweep_weight",
}
TABLE: dict[str, Any] = {  # of a CPU, as Instant-NGP's preset has it
    "table_learning_rate": 2e-2,
    "table_width": 32,
    **TABLE_ON_A_CPU,
    "samples_per_step": 1 << 15,
    "steps_per_diagonal": 384,
    "cone_angle": 1 / 96,
    "transmittance_threshold": 1e-3,
    "table_occupancy_threshold": 0.15,
    "hash_weight_decay": 0.3,
    "huber_delta": 0.3,
}
FLOWING = 0.05  # of a budget of seconds: the share that learning what is likely may take
STRIDES = (1, 2, 4)  # pixels between rays of a patch: what is smooth, and what looks like a photograph, is so in each


@dataclass(frozen=True)
class Glimpses(Batch):
    """Rays that photographs tell of, and patches of rays that nobody photographed.

    unseen: rays of patches, one after another
    """

    unseen: Rays | None = None

    def to(self, device: torch.device | str) -> Glimpses:
        moved = super().to(device)
        unseen = None if self.unseen is None else self.unseen.to(device)
        return Glimpses(moved.rays, moved.rgb, moved.alpha, moved.extra, unseen)


class RegNeRF(RayMethod):
    """Mip-NeRF or Instant-NGP, which learns as ever from photographs, and is told off for what it shows elsewhere."""

    Config = Config

    def __init__(self, frame: Frame, config: Any = None):
        config = config or Config()
        super().__init__(frame, config)
        self.marcher: MipNeRF | InstantNGP
        if config.field == "hash":
            self.marcher = InstantNGP(frame, replace(config.numbers_of(NgpConfig), exposure_correction="no"))
        else:
            self.marcher = MipNeRF(frame, config.numbers_of(MipConfig))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.flow = PatchFlow() if config.likelihood_weight else None
        self.rays_per_chunk = self.marcher.rays_per_chunk
        self._progress = 0.0

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """On a GPU the paper's numbers. On a CPU a hash table, for after a laptop's minutes a network is still a blur;
        where a network is asked for all the same, a smaller one. Fewer patches, too; and what the paper does in its
        first some hundred steps takes a larger share of the fewer there are."""
        if device.type == "cuda":
            return Config()
        own = asdict(MipNeRF.preset(device))
        return Config(**own, field="hash", unseen_patches=8, annealing=0.25, depth_settling=0.25, **TABLE)

    @classmethod
    def smallest(cls) -> Any:
        """Tiny networks and two patches: every part, within some twenty quick steps."""
        return Config(**asdict(MipNeRF.smallest()), unseen_patches=2, flow_steps=8)

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        if config.field == "hash":
            return InstantNGP.further_bytes(frame, config.numbers_of(NgpConfig), learning)
        return MipNeRF.further_bytes(frame, config.numbers_of(MipConfig), learning)

    # Being seen

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit."""
        return self.marcher.density(points)

    def field(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions."""
        return self.marcher.field(points, directions)

    def looks(self, rays: Rays) -> list[Look]:
        return self.marcher.looks(rays)

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        return self.marcher.render_rays(rays, background)

    # Learning

    def begin(self, scene: Scene, seconds: float = math.inf) -> None:
        self.marcher.begin(scene, seconds)
        if self.flow:
            self.flow.learn(scene, self.config.flow_steps, self.random(-1), FLOWING * seconds)

    def rehearse_begin(self) -> None:
        self.marcher.rehearse_begin()

    def rays_in_a_step(self, data: Scene) -> float:
        return self.marcher.rays_in_a_step(data)

    def batch(self, data: Scene, generator: torch.Generator) -> Glimpses:
        seen, unseen = self.marcher.batch(data, generator), None
        if count := self.config.unseen_patches:
            cameras = unseen_cameras(data.cameras[data.splits["train"]], count, generator)
            unseen = patches(cameras, SIDE, STRIDES, generator)
        return Glimpses(seen.rays, seen.rgb, seen.alpha, seen.extra, unseen).to(self.device)

    def loss(self, batch: Any, step: int) -> dict[str, Tensor]:
        generator, unseen = self.random(step), batch.unseen
        rays = self.marcher.poses(batch.rays) if self.marcher.poses else batch.rays
        rays = rays if unseen is None else joined(rays, unseen)
        looks, terms = self._look(rays, generator)
        table = isinstance(self.marcher, InstantNGP)
        opaque = self.marcher.unbounded is not None if table else self.config.random_backdrop and self.frame.reach > 1
        background = backdrop(batch, self.background, generator, opaque=opaque)
        for look, weight in looks:
            # Of a patch, the picture before the scene's own background is judged.
            behind = background.expand(len(batch), 3)
            if unseen is not None:
                behind = torch.cat([behind, self.background.expand(len(unseen), 3)])
            places = evened(look.samples.t)[:, None]
            whole = composite(look.samples, look.density, look.rgb, behind, places=places)
            seen, rest = (part(whole, x) for x in (slice(len(batch)), slice(len(batch), None)))
            residual, self.figures["mse"] = residuals(seen, batch, background)
            if table:
                terms["huber"] = huber(residual, self.config.huber_delta)
            elif weight:
                terms[look.name] = weight * residual.square().mean()
        if unseen is not None:
            terms |= self._unlike(rest)
        if self.config.occlusion_weight:
            terms["occlusion"] = self.config.occlusion_weight * self._before_cameras(rays, looks[-1][0])
        self.figures |= self.marcher.figures | {"mse": self.figures["mse"]}
        return terms

    def _look(self, rays: Rays, generator: torch.Generator) -> tuple[list[tuple[Look, float]], dict[str, Tensor]]:
        """A step's looks along rays with the weights of their colours, the one that counts last; and what else they
        cost, by name."""
        if isinstance(self.marcher, InstantNGP):
            look, terms = self.marcher.look_to_learn(rays, generator)
            return [(look, 1.0)], terms
        weights = self.marcher.pass_weights
        return [(look, weights.get(look.name, 1.0)) for look in self.marcher.looks(rays, generator)], {}

    def _unlike(self, seen: Rendering) -> dict[str, Tensor]:
        """What patches that nobody photographed cost: how rough their depth is, how unlikely their colours are."""
        c, shape, terms = self.config, (-1, SIDE, SIDE), {}
        opacity = seen.opacity.view(shape)
        place = (seen.extra["places"][:, 0] / seen.opacity.clamp_min(1e-3)).view(shape)
        if c.depth_weight:
            weight = c.depth_weight
            if self._progress < c.depth_settling:
                weight += (c.depth_weight_start - weight) * (1 - self._progress / c.depth_settling)
            terms["smoothness"] = weight * roughness(place, opacity)
        if self.flow:
            terms["likelihood"] = c.likelihood_weight * self.flow(seen.rgb.view(*shape, 3)).mean()
        return terms

    def _before_cameras(self, rays: Rays, look: Look) -> Tensor:
        """How thick what stands in the first share of each ray is, mean of all rays."""
        space = self.marcher.space
        share = torch.full((len(rays), 1), self.config.occlusion_range, device=rays.origins.device)
        until = space.distance(share, rays, *space.interval(rays))[:, 0]
        return thickness_before(look.samples, look.density, until).mean()

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return self.marcher.optimizers()

    def learning_rate(self, step: int, progress: float) -> float | dict[str, float]:
        return self.marcher.learning_rate(step, progress)

    def before_step(self, step: int, progress: float) -> None:
        c, self._progress = self.config, progress
        grown = progress / c.annealing if progress < c.annealing else 1.0
        self.marcher.sampled = max(grown, c.annealing_start)
        if isinstance(self.marcher, InstantNGP):
            self.marcher.joined = progress / c.coarse_to_fine if progress < c.coarse_to_fine else 1.0
        self.marcher.before_step(step, progress)

    def after_step(self, step: int) -> None:
        self.marcher.after_step(step)

    def refined(self, cameras: Camera) -> Camera:
        return self.marcher.refined(cameras)


def joined(first: Rays, second: Rays) -> Rays:
    """Rays, and others after them, of no photograph."""
    pairs = ((getattr(first, name), getattr(second, name)) for name in ("origins", "directions", "radius"))
    return Rays(*(torch.cat(pair) for pair in pairs))


def part(whole: Rendering, rays: slice) -> Rendering:
    """What some of the rays saw."""
    extra = {name: values[rays] for name, values in whole.extra.items()}
    return Rendering(whole.rgb[rays], whole.depth[rays], whole.opacity[rays], extra)
