"""RegNeRF: few photographs, a scene smooth and likely between them (Niemeyer et al. 2022, arXiv 2112.00724).

Small patches of pictures that nobody took are rendered as well. Nothing is known of their colours; but depth that jumps
about, and patches such as no photograph has, say that the field explains each photograph by itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...camera.rays import Look, Rays, Rendering
from ...components.fields.coordinate_field import FrustumField, NetworkNumbers
from ...components.fields.hash_field import HashField, HashNumbers
from ...components.fields.spaces import NDC, space_of
from ...components.sampling.cone_sampler import ConeSampler
from ...components.sampling.hierarchical_sampler import CPU_NETWORK, TINY_NETWORK, RayNumbers
from ...components.sampling.occupancy import MaskNumbers
from ...components.sampling.occupancy_sampler import MIN_RESOLUTION, OccupancyNumbers, StepNumbers
from ...components.sampling.samplers import CPU_HASH, ProposalNumbers, sampler_for, sampling_bytes
from ...components.training.photometric import backdrop, huber, residuals
from ...components.training.pose_refinement import PoseNumbers, poses_for
from ...components.training.regularizers import (
    near_thickness,
    normalized_distance,
    opacity_entropy,
    patches,
    roughness,
    unseen_cameras,
)
from ...components.training.schedules import BandSchedule, falling, hold_and_decay, joining_of
from ...datasets.scene import Batch, Frame, Scene
from ...files.ranges import LearningRate, NonNegative, PositiveShare, Share, Steps, Width, between, changed
from ...method import BaseConfig, FieldMethod, seeded
from ...volume import composite
from .patch_flow import SIDE, PatchFlow, backdrops


@dataclass(frozen=True)
class Config(BaseConfig):
    """The release's numbers for three photographs (configs/llff3.gin), with those of its flow ours and Instant-NGP's of
    the table; `RegNeRF.preset` has a CPU's."""

    network: NetworkNumbers = NetworkNumbers(position_frequencies=16)
    rays: RayNumbers = RayNumbers(128, 128)
    mask: MaskNumbers = MaskNumbers()
    poses: PoseNumbers = PoseNumbers()
    table: HashNumbers = HashNumbers()
    steps: StepNumbers = StepNumbers()
    proposals: ProposalNumbers = ProposalNumbers()
    field: Literal["network", "hash", "auto"] = "network"  # mip-NeRF's network; a faster hash table; auto: see field_of
    unseen_patches: Annotated[int, between(0, 4096)] = 64  # patches of 8 x 8 unobserved rays in a step; 0: none
    depth_weight: NonNegative = 0.1  # weight of depth's roughness in these patches, eq. 6; higher smooths depth
    depth_weight_start: NonNegative = 400.0  # weight of that roughness at first, which falls to depth_weight
    depth_settling: Share = 512 / 69_768  # share of the budget in which it falls
    likelihood_weight: NonNegative = 1e-3  # weight of the patches' negative log likelihood, eq. 8; 0: no flow
    opacity_weight: NonNegative = 0.0  # weight of the patches' entropy of opacity before objects; higher: less fog
    flow_steps: Steps = 400  # steps that train the normalising flow of eq. 8, of 512 patches each
    coarse_to_fine: Share = 0.0  # share of the budget in which finer octaves of the network are added; 0: at once
    occlusion_weight: NonNegative = 0.0  # weight of density right before cameras (Yang 2023, eq. 5); 0: off
    occlusion_range: Share = 0.1  # share of each ray that counts as right before its camera
    random_backdrop: bool = True  # random colours behind open captures for the network; off: the scene's own
    annealing: Share = 512 / 69_768  # share of the budget in which samples spread along rays, eq. 10
    forward_annealing_start: PositiveShare = 1e-4  # share of forward-facing rays, from the far plane on, at first
    # Of the network.
    hidden_width: Width = 256  # channels of a layer
    density_noise: NonNegative = 1.0  # deviation of noise on raw density in training; 0: none
    gradient_clip: NonNegative = 0.1  # largest gradient of a weight, and largest norm of all; 0: no limit
    coarse_loss_weight: NonNegative = 0.1  # 0: the coarse pass only guides the fine one
    learning_rate: LearningRate = 2e-3  # learning rate of the network at first; higher: faster, may diverge
    final_learning_rate: LearningRate = 2e-5  # learning rate of the network at the end of the budget
    warmup: Share = 512 / 69_768  # share of the budget in which the learning rate grows
    # Of the hash table and its networks.
    table_learning_rate: LearningRate = 1e-2  # learning rate of the hash table and its networks at first
    table_coarse_to_fine: Share = 0.0  # share of the budget in which finer levels of the table are added; 0: at once
    table_width: Width = 64  # neurons of a hidden layer behind the hash table; wider costs time
    samples_per_step: Annotated[int, between(64, 1 << 24)] = 1 << 18  # of the hash table: samples in a step
    transmittance_threshold: Share = 1e-4  # transmittance at which a ray terminates; higher is faster, less exact
    table_occupancy_threshold: NonNegative = 0.05  # of the table: optical thickness of an empty cell; higher: faster
    hash_weight_decay: NonNegative = 0.0  # decoupled weight decay of an object's table, towards a density of 1
    huber_delta: PositiveShare = 0.1  # of the hash table: residual at which the loss turns from squared to linear

    @property
    def occupancy(self) -> OccupancyNumbers:
        """Numbers of the hash table's occupancy grid."""
        cells = max(MIN_RESOLUTION, self.mask.occupancy_resolution)
        return OccupancyNumbers(
            self.samples_per_step, self.transmittance_threshold, cells, self.table_occupancy_threshold
        )


SOURCES = {  # of the numbers of `paper`; the others are ours
    "google-research/google-research, regnerf/configs/llff3.gin (30adf0e)": (
        "depth_weight depth_weight_start depth_settling annealing forward_annealing_start density_noise gradient_clip "
        "learning_rate final_learning_rate warmup"
    ),
    "google-research/google-research, regnerf/configs/dtu3.gin (30adf0e)": "annealing_start",
    "google-research/google-research, regnerf/internal/configs.py (30adf0e)": (
        "rays_per_step unseen_patches coarse_loss_weight resample_padding position_frequencies"
    ),
    "google-research/google-research, regnerf/internal/models.py (012c607)": (
        "field depth hidden_width coarse_samples fine_samples"
    ),
}


ANNEALING_START = 0.5  # p_s, share of each ray, around its middle, that is sampled at first, eq. 10
FINAL_TABLE_LEARNING_RATE = 1e-3  # learning rate of the hash table and its networks at the end
DECAY_START = 0.3  # share of the budget before the table's learning rate falls
FLOWING = 0.05  # of a budget of seconds: the share that learning what is likely may take
MIN_TABLE_VIEWS = 6  # photographs of an object from which a table is ahead of the network (docs/methods/regnerf.md)
STRIDES = (1, 2, 4)  # pixels between rays of a patch: what is smooth, and what looks like a photograph, is so in each


@dataclass(frozen=True)
class Glimpses(Batch):
    """Rays of photographs, and patches of rays at unobserved views.

    unseen: rays of patches, concatenated
    """

    unseen: Rays | None = None

    def to(self, device: torch.device | str) -> Glimpses:
        moved = super().to(device)
        unseen = None if self.unseen is None else self.unseen.to(device)
        return Glimpses(moved.rays, moved.rgb, moved.alpha, moved.extra, unseen)


class RegNeRF(FieldMethod):
    """Mip-NeRF's network or a hash table, with regularisation of patches at unobserved views."""

    Config = Config
    network: HashField | FrustumField

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        space, self.by_table = space_of(frame), field_of(frame, c) == "hash"
        self.poses = poses_for(frame, c.poses)
        share = c.table_coarse_to_fine if self.by_table else c.coarse_to_fine
        self.bands = BandSchedule(share) if share else None
        joining = joining_of(self.poses, self.bands)
        if self.by_table:
            with seeded(c.seed):
                self.network = HashField(c.table, c.table_width, space, frame.reach, joining=joining)
            self.sampler = sampler_for(frame, space, c.occupancy, c.proposals, steps=c.steps)
        else:
            self.network = FrustumField(c.network, c.hidden_width, space, joining=joining, noise=c.density_noise)
            self.sampler = ConeSampler(space, c.rays, c.mask, c.coarse_loss_weight > 0)
            self.sampler.sampled_from = 1.0 if isinstance(space, NDC) else 0.5
        with seeded(c.seed):
            self.flow = PatchFlow() if c.likelihood_weight else None

    @classmethod
    def cpu_preset(cls) -> Any:
        """A hash table, for after a laptop's minutes a network is still a blur; a smaller network for objects of few
        photographs. Fewer patches, and a larger share of the budget for what the paper does in its first steps."""
        return changed(Config(**CPU_NETWORK), depth=6, skip_layer=3, unseen_patches=8, annealing=0.25,
            depth_settling=0.25, depth_weight=0.05, depth_weight_start=5.0, forward_annealing_start=0.5,
            density_noise=0.0, gradient_clip=0.0, coarse_to_fine=0.9, field="auto", table=CPU_HASH["table"],
            steps=CPU_HASH["steps"], table_width=32, samples_per_step=1 << 15, transmittance_threshold=1e-3,
            table_occupancy_threshold=0.15, table_learning_rate=2e-2, hash_weight_decay=0.3,
            huber_delta=0.3)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """Tiny networks and two patches: every part, within some twenty quick steps."""
        return changed(
            Config(**TINY_NETWORK), depth=3, skip_layer=2, position_frequencies=6, unseen_patches=2, flow_steps=8
        )

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        return sampling_bytes(frame, replace(config, field=field_of(frame, config)), learning)

    # Learning

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        super().begin(data, seconds)
        if self.flow:
            self.flow.learn(data, self.config.flow_steps, self.random(-1), FLOWING * seconds)

    def batch(self, data: Scene, generator: torch.Generator) -> Glimpses:
        seen, unseen = super().batch(data, generator), None
        if count := self.config.unseen_patches:
            cameras = unseen_cameras(data.cameras[data.splits["train"]], count, generator)
            unseen = patches(cameras, SIDE, STRIDES, generator)
        return Glimpses(seen.rays, seen.rgb, seen.alpha, seen.extra, unseen).to(self.device)

    def loss(self, batch: Any, step: int) -> dict[str, Tensor]:
        c, generator, unseen = self.config, self.random(step), batch.unseen
        rays = self.refine_rays(batch.rays)
        rays = rays if unseen is None else joined(rays, unseen)
        passes, terms = self.learn_along(rays, generator)
        opaque = self.sampler.is_open if self.by_table else c.random_backdrop and self.frame.is_open
        background = backdrop(batch, self.background, generator, opaque=opaque)
        behind = background.expand(len(batch), 3)
        if unseen is not None:
            behind = torch.cat([behind, self._behind_patches(unseen, batch.alpha is not None, generator)])
        for each in passes:
            if not (weight := self.pass_weights.get(each.name, 1.0)):
                continue
            look = each.look(self.network)
            places = normalized_distance(look.samples.t)[:, None]
            whole = composite(look.samples, look.density, look.rgb, behind, places=places)
            seen, rest = (part(whole, x) for x in (slice(len(batch)), slice(len(batch), None)))
            residual, self.figures["mse"] = residuals(seen, batch, background)
            if self.by_table:
                terms["huber"] = huber(residual, c.huber_delta)
            else:
                terms[look.name] = weight * residual.square().sum(-1).mean()
            if unseen is not None and each is not passes[-1]:
                terms["coarse smoothness"] = c.coarse_loss_weight * self._roughness(rest)
        if unseen is not None:
            terms |= self._unlike(rest)
        if c.occlusion_weight:
            terms["occlusion"] = c.occlusion_weight * self._before_cameras(rays, look)
        return terms

    def _behind_patches(self, unseen: Rays, random: bool, generator: torch.Generator) -> Float[Tensor, "ray 3"]:
        """Background colours of unobserved patches: the scene's own, or for photographs with alpha a random one for
        each patch, as in the flow's training patches. Before the scene's own, density of its colour has no cost."""
        if not random:
            return self.background.expand(len(unseen), 3)
        return backdrops(len(unseen) // SIDE**2, generator).repeat_interleave(SIDE**2, 0).to(self.device)

    def _unlike(self, seen: Rendering) -> dict[str, Tensor]:
        """Loss terms of unobserved patches: roughness of their depth, negative log likelihood of their colours."""
        c, terms = self.config, {}
        if c.depth_weight:
            weight = c.depth_weight
            if self.progress < c.depth_settling:
                weight += (c.depth_weight_start - weight) * (1 - self.progress / c.depth_settling)
            terms["smoothness"] = weight * self._roughness(seen)
        if c.opacity_weight and not self.frame.is_open:
            terms["opacity"] = c.opacity_weight * opacity_entropy(seen.opacity)
        if self.flow:
            terms["likelihood"] = c.likelihood_weight * self.flow(seen.rgb.view(-1, SIDE, SIDE, 3)).mean()
        return terms

    def _roughness(self, seen: Rendering) -> Tensor:
        """Roughness of patches' expected t / (1 + t)."""
        shape = (-1, SIDE, SIDE)
        place = seen.extra["places"][:, 0] / seen.opacity.clamp_min(1e-3)
        return roughness(place.view(shape), seen.opacity.view(shape))

    def _before_cameras(self, rays: Rays, look: Look) -> Tensor:
        """Optical thickness of the first share of each ray, mean over rays."""
        space = self.network.space
        share = torch.full((len(rays), 1), self.config.occlusion_range, device=rays.origins.device)
        until = space.distance(share, rays, *space.interval(rays))[:, 0]
        return near_thickness(look.samples, look.density, until).mean()

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c = self.config
        if self.by_table:
            own = self.network.optimizers_at(c.table_learning_rate, c.hash_weight_decay)
        else:
            own = [clipped(torch.optim.Adam(self.network.parameters(), c.learning_rate), c.gradient_clip)]
        return [*own, *super().optimizers()]

    def learning_rate(self, step: int, progress: float) -> float:
        c = self.config
        if self.by_table:
            return hold_and_decay(c.table_learning_rate, FINAL_TABLE_LEARNING_RATE, step, progress, DECAY_START)
        return falling(c.learning_rate, c.final_learning_rate, progress, c.warmup)

    def before_step(self, step: int, progress: float) -> None:
        c = self.config
        grown = progress / c.annealing if progress < c.annealing else 1.0
        first: Any = c.forward_annealing_start if isinstance(self.network.space, NDC) else ANNEALING_START
        self.sampler.sampled_share = max(grown, first)
        super().before_step(step, progress)


def field_of(frame: Frame, config: Config) -> str:
    """The field of a Config in a frame. With auto that is the network for an object of few photographs, to which a
    table would overfit, and the table elsewhere."""
    if config.field != "auto":
        return config.field
    few = 0 < frame.train_count < MIN_TABLE_VIEWS
    return "network" if few and not frame.is_open else "hash"


def clipped(optimizer: torch.optim.Optimizer, most: float) -> torch.optim.Optimizer:
    """An optimizer that limits gradients ahead of its steps: each number, then the norm of all; 0: neither."""

    def clip(optimizer: torch.optim.Optimizer, *_: Any) -> None:
        weights = [weight for group in optimizer.param_groups for weight in group["params"]]
        nn.utils.clip_grad_value_(weights, most)
        nn.utils.clip_grad_norm_(weights, most)

    if most:
        optimizer.register_step_pre_hook(clip)
    return optimizer


def joined(first: Rays, second: Rays) -> Rays:
    """Rays concatenated with others of no photograph."""
    pairs = ((getattr(first, name), getattr(second, name)) for name in ("origins", "directions", "radius"))
    return Rays(*(torch.cat(pair) for pair in pairs))


def part(whole: Rendering, rays: slice) -> Rendering:
    """Rendering of some of the rays."""
    extra = {name: values[rays] for name, values in whole.extra.items()}
    return Rendering(whole.rgb[rays], whole.depth[rays], whole.opacity[rays], extra)
