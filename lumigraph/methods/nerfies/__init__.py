"""Nerfies: a scene that deforms from moment to moment (Park et al. 2021, arXiv 2011.12948; slices: 2106.13228)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad, softplus

from ...camera.rays import Rays
from ...components.backbone import CPU_BACKBONE, TINY_BACKBONE, BackboneNumbers
from ...components.fields.appearance import AppearanceCodes
from ...components.fields.coordinate_field import NetworkNumbers
from ...components.fields.hash_field import CODES_RATE
from ...components.fields.spaces import space_of
from ...components.sampling.hierarchical_sampler import RAYS_WITH_FEATURES, HierarchicalSampler, RayNumbers
from ...components.sampling.samplers import sampling_bytes
from ...components.training.photometric import backdrop
from ...components.training.schedules import BandSchedule, held_decay, joining_of
from ...datasets.scene import Batch, Frame, Scene
from ...files.ranges import Layers, NonNegative, Octaves, PositiveShare, Share, Width, between, changed
from ...method import BaseConfig, FieldMethod, Pass, seeded
from ...method.field import Densities, Points
from ...method.sampler import Density
from ...volume import composite, weights_of
from .canonical import SlicedHash, SlicedNetwork, WarpedField
from .elastic import elastic_loss, geman_mcclure
from .warp import MomentCodes, Motion, MotionField, SliceField

Code = Annotated[int, between(0, 1024)]  # numbers of a code; 0 for none
FIRST_MOMENTS = 0.1  # share of the capture that is learnt from at first, where moments join
ELASTIC_SCALE = 0.03  # c of the elastic term's robust loss, section 3.3
BACKGROUND_WEIGHT = 1.0  # weight of background points that must not move, section 3.4
BACKGROUND_SCALE = 0.001  # c of the background's robust loss, in scene units (the authors' release)

MOMENT_CODE = 8  # numbers of a moment's code, section 4
SLICE_WIDTH = 64  # channels of the slice's network (Park 2021b, section 5.1)


@dataclass(frozen=True)
class DeformationNumbers:
    """A Config's numbers of the deformation; the paper's (Park 2021)."""

    motion: Motion = "se3"  # motion of a point: a screw motion, section 3.2, or a translation; none: only slices
    moment_waves: bool = False  # codes begin as waves of time, which suits few steps; off: at random, section 4
    deformation_frequencies: Octaves = 8  # m, octaves of the encoding at the end of annealing, section 3.5
    deformation_depth: Layers = 6  # hidden layers, section 4; more cost time
    deformation_width: Width = 128  # channels of a layer, section 4; wider costs time
    deformation_skip: Layers = 4  # layer whose activation the input joins again, section 4
    annealing: Share = 0.32  # share of the budget in which octaves join, 80k of 250k steps, section 3.5; 0: at once
    elastic_weight: NonNegative = 1e-3  # lambda, weight of the elastic loss at first, section 4; higher: more rigid
    elastic_until: Share = 0.2  # share of the budget before that weight falls, 50k of 250k steps
    elastic_samples: Annotated[int, between(1, 1 << 20)] = 8192  # samples of a step where it is measured
    background_points: Annotated[int, between(1, 1 << 20)] = 16384  # of them in a step
    growth: Share = 0.0  # share of the budget in which later moments join the first (Pumarola 2021); 0: at once
    slice_dimensions: Annotated[int, between(0, 16)] = 0  # ambient dimensions of HyperNeRF's slice; 0: none


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers; `Nerfies.preset` has those of a plain CPU."""

    backbone: BackboneNumbers = BackboneNumbers(
        NetworkNumbers(position_frequencies=8),  # the authors' release
        learning_rate=1e-3,  # section 4
        final_learning_rate=1e-3 * 0.1**0.5,  # the release's: a tenth after twice its steps
    )
    rays: RayNumbers = RayNumbers(128, 128, rays_per_step=6144)  # section 4
    deformation: DeformationNumbers = DeformationNumbers()
    table_annealing: Share = 0.0  # share of the budget in which levels of the hash table join; 0: at once
    appearance_code: Code = 8  # numbers of a photograph's appearance, section 3.1; 0: all have the same
    deformation_rate: PositiveShare = 1.0  # share of the learning rate that the deformation and its codes learn at


SOURCES = {  # of the numbers of `paper`; the others are ours
    "google/nerfies, configs/gpu_vrig_paper.gin (1a38512)": (
        "field depth position_frequencies hidden_width coarse_samples fine_samples rays_per_step learning_rate "
        "final_learning_rate elastic_weight background_weight"
    ),
    "google/nerfies, configs/defaults.gin (1a38512)": "motion moment_code deformation_frequencies",
    "google/nerfies, configs/gpu_quarterhd.gin (1a38512), its 250 000 steps": "annealing elastic_until",
    "google/nerfies, nerfies/configs.py (1a38512)": "appearance_code background_points",
    "google/nerfies, nerfies/warping.py (1a38512)": "deformation_depth deformation_width deformation_skip",
    "google/nerfies, nerfies/training.py (1a38512)": "elastic_scale",
    "google/nerfies, nerfies/models.py (1a38512), which has no such part": "slice_dimensions slice_width",
}


class Nerfies(FieldMethod):
    """A canonical scene, and a field of motions from each moment to it."""

    Config, further_bytes, learning_rate = Config, staticmethod(sampling_bytes), held_decay
    network: WarpedField
    background_points: Tensor
    grows = ("background_points",)

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        b, d, space = c.backbone, c.deformation, space_of(frame)
        shape, ambient = (d.deformation_depth, d.deformation_width, d.deformation_skip), d.slice_dimensions
        self.levels = BandSchedule(c.table_annealing) if c.table_annealing and b.hashed else None
        kinds = SlicedHash, partial(SlicedNetwork, activation=softplus, keep_input=True)
        common: dict[str, Any] = {"code": c.appearance_code, "joining": joining_of(self.levels), "ambient": ambient}
        rays = partial(HierarchicalSampler, space, c.rays, rays_per_chunk=RAYS_WITH_FEATURES)
        self.sampler = b.sampler(frame, space) if b.hashed else rays()
        with seeded(c.seed):
            canonical = b.build(frame, space, *kinds, **common)
            first = None if b.hashed else b.build(frame, space, *kinds, **common)
            self.moment_codes = MomentCodes(frame, MOMENT_CODE, d.moment_waves)
            bands = d.deformation_frequencies, MOMENT_CODE
            motion = None if d.motion == "none" else MotionField(space, d.motion, *bands, shape, d.annealing)
            narrow = d.deformation_depth, SLICE_WIDTH, d.deformation_skip
            slices = SliceField(space, *bands, narrow, ambient) if ambient else None
        self.network = WarpedField(canonical, motion, slices, c.appearance_code, first)
        self.appearance = AppearanceCodes(frame.image_count, c.appearance_code) if c.appearance_code else None
        self.register_buffer("background_points", torch.zeros(0, 3))

    @classmethod
    def cpu_preset(cls) -> Any:
        """A hash table as canonical scene, a narrower deformation, fewer samples and cells, as each is deformed."""
        return changed(changed(Config(), **CPU_BACKBONE), learning_rate=1e-2, samples_per_step=1 << 13,
            occupancy_resolution=64, appearance_code=0, deformation_depth=4, deformation_width=64, deformation_skip=2,
            annealing=0.5, elastic_samples=256, background_points=1024, elastic_until=0.5, moment_waves=True,
            deformation_frequencies=4, growth=0.5, table_annealing=0.5, deformation_rate=0.3)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """A tiny table under a tiny deformation with a slice, within some twenty quick steps."""
        return changed(Config(), **TINY_BACKBONE, appearance_code=2, deformation_depth=2, deformation_width=16,
            deformation_skip=1, deformation_frequencies=4, elastic_samples=64, background_points=64,
            slice_dimensions=1, deformation_rate=0.1)  # fmt: skip

    # Codes

    def code(self, rays: Rays) -> Float[Tensor, "#ray code"]:
        """Appearance, and the code of each ray's moment."""
        moments = self.moment_codes(self.moments(rays))
        if self.appearance is None:
            return moments
        if self.training and rays.image_index is not None:
            return torch.cat([self.appearance(rays.image_index), moments], 1)
        return torch.cat([self.appearance.shown(self).expand(len(moments), -1), moments], 1)

    @property
    def shown_code(self) -> Float[Tensor, "1 code"]:
        first, _ = self.frame.times or (0.0, 0.0)
        return self.code_at(float(self.settings.get("time", first)))

    def code_at(self, time: float) -> Float[Tensor, "1 code"]:
        """The appearance of the settings, and the code of a moment."""
        moments = self.moment_codes(torch.full((1,), time, device=self.device))
        shown = [] if self.appearance is None else [self.appearance.shown(self)[None]]
        return torch.cat([*shown, moments], 1)

    def density(self, points: Points) -> Densities:
        return self.network.density(points, self.shown_code.expand(len(points), -1))

    def density_in_training(self, generator: torch.Generator) -> Density:
        """Density of each point at a random moment."""

        def density(points: Points) -> Densities:
            codes = self.moment_codes(self.random_times(points, generator))
            return self.network.density(points, pad(codes, (self.network.appearance, 0)))

        return density

    # Learning

    def begin(self, data: Scene, seconds: float = float("inf")) -> None:
        if data.points is not None:
            self.background_points = data.points.to(self.device)
        super().begin(data, seconds)

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        """Rays of the times that have joined: at first those of a tenth of the capture."""
        d, time = self.config.deformation, data.cameras.time
        if self.progress < d.growth and time is not None and self.frame.times is not None:
            first, last = self.frame.times
            until = first + (last - first) * (FIRST_MOMENTS + (1 - FIRST_MOMENTS) * self.progress / d.growth)
            train = data.splits["train"]
            data = replace(data, splits={"train": train[time[train] <= until]})
        return super().batch(data, generator)

    def elastic_weight(self) -> float:
        """Weight of the elastic loss: constant, then falling by half a cosine over twice that time (the authors'
        release)."""
        d = self.config.deformation
        fallen = min(max(self.progress - d.elastic_until, 0.0) / max(2 * d.elastic_until, 1e-9), 1.0)
        return d.elastic_weight * 0.5 * (1 + float(torch.cos(torch.tensor(torch.pi * fallen))))

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """The squared error of each pass, elastic loss (eq. 10) and background loss (eq. 12)."""
        generator = self.random(step)
        passes, terms = self.learn(batch.rays, generator)
        background, code = backdrop(batch, self.background, generator, self.sampler.is_open), self.code(batch.rays)
        target = batch.before(background)
        for each in passes:
            look = each.look(self.network, code)
            error = (composite(look.samples, look.density, look.rgb, background).rgb - target).square().mean()
            self.figures["mse"] = float(error.detach())  # of the last pass in the end
            terms[each.name] = error
        motion = self.network.motion
        if motion is not None and (weight := self.elastic_weight()):
            terms["elastic"] = weight * self.stretching(motion, batch.rays, passes[-1], code, generator)
        if motion is not None and len(self.background_points):
            terms["background"] = BACKGROUND_WEIGHT * self.restlessness(motion, generator)
        return terms

    def stretching(
        self, motion: MotionField, rays: Rays, seen: Pass, code: Float[Tensor, "ray code"], generator: torch.Generator
    ) -> Float[Tensor, ""]:
        """The elastic loss along rays, weighted by the rendering weights: at samples that are drawn by them."""
        d = self.config.deformation
        weights = weights_of(seen.samples, seen.density).detach()
        total = float(weights.sum())
        if not total:
            return weights.sum()
        drawn = torch.multinomial(weights.cpu(), d.elastic_samples, True, generator=generator).to(weights.device)
        ray = seen.samples.ray_index[drawn]
        points = rays.origins[ray] + seen.samples.t[drawn, None] * rays.directions[ray]
        jacobian = motion.jacobian(points, code[ray, self.network.appearance :])
        return total / len(rays) * elastic_loss(jacobian, ELASTIC_SCALE).mean()

    def restlessness(self, motion: MotionField, generator: torch.Generator) -> Float[Tensor, ""]:
        """Displacement of static background points at random times, by a robust loss (eq. 12)."""
        count, known = self.config.deformation.background_points, self.background_points
        points = known[torch.randint(len(known), (count,), generator=generator).to(self.device)]
        first, last = self.frame.times or (0.0, 0.0)
        times = first + (last - first) * torch.rand(count, generator=generator).to(self.device)
        away = motion(points, self.moment_codes(times)) - points
        return geman_mcclure(away.square().sum(-1), BACKGROUND_SCALE).mean()

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c, b, network = self.config, self.config.backbone, self.network
        moving = [part for part in (network.motion, network.ambient) if part is not None]
        deformation = {"params": [p for part in moving for p in part.parameters()], "scale": c.deformation_rate}
        codes = {"params": [self.moment_codes.codes], "scale": c.deformation_rate}
        groups = [group for group in (deformation, codes) if group["params"]]
        if self.appearance is not None:
            groups.append({"params": [self.appearance.codes], "scale": b.scale(CODES_RATE)})
        own = b.optimizers(*(x for x in (network.canonical, network.first) if x is not None))
        return [*own, torch.optim.Adam(groups, b.learning_rate), *super().optimizers()]

    # Motion

    @torch.no_grad()
    def follow(self, points: Points, start: float, end: float) -> Points:
        """Positions at one time of surface points of another: those with the same canonical position."""
        motion = self.network.motion
        if motion is None:
            return points
        before, after = (self.moment_codes(points.new_full((len(points),), t)) for t in (start, end))
        return motion.inverse(motion(points, before), after, points)
