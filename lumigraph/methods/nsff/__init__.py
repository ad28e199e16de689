"""NSFF: a static and a dynamic field with scene flow, from one moving camera (Li et al. 2021, arXiv 2011.13084)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...camera.rays import Rays, Rendering, Samples
from ...components.backbone import CPU_BACKBONE, TINY_BACKBONE, BackboneNumbers
from ...components.fields.spaces import space_of
from ...components.sampling.samplers import sampling_bytes
from ...components.training.photometric import backdrop
from ...components.training.schedules import held_decay
from ...datasets.scene import Batch, Frame, Scene
from ...files.ranges import NonNegative, PositiveShare, between, changed
from ...method import BaseConfig, FieldMethod, seeded
from ...method.controls import Control, moment
from ...method.field import Densities, Directions, Points
from ...method.sampler import Density
from ...volume import composite
from .fields import BlendedField, NetworkField, StaticHash, TimeHash
from .priors import DepthSource, MotionPriors, seen
from .sampler import EvenNumbers, EvenSampler

OCCLUSION_WEIGHT = 0.1  # beta_w, of disocclusion weights that differ from 1, eq. 6
CYCLE_WEIGHT = 1.0  # weight of flow forward and back that do not cancel, eq. 7
SMOOTH_WEIGHT = 0.1  # weight of flow that differs between samples of a ray, or between moments
MIN_WEIGHT = 0.01  # weight of flow itself
ROWS = 288  # of the pictures in whose pixels the release measures errors of flow
PRIOR_FALL = 10.0  # factor by which the weights of flow and depth fall each time (the authors' release)
LAST_SCALE = 0.005  # of those weights, below which they are 0
MIN_OPACITY = 0.5  # of rays whose optical flow counts
NEIGHBOURS = 2.0  # falloff of smoothness with distance between samples, per unit of coordinates (eq. in section 3.2)


@dataclass(frozen=True)
class FlowNumbers:
    """A Config's parameters of scene flow; the release's (config_kid-running), explained in section 3 of the paper."""

    neighbours: Annotated[int, between(0, 2)] = 2  # moments to either side that are warped; 0: time is a mere input
    both_ways: bool = True  # warp forward and back in each step; off: one of them at random, in half the time
    max_flow: PositiveShare = 1.0  # largest flow to the next moment along an axis, in coordinates of the space
    flow_weight: NonNegative = 0.02  # of optical flow at first, per pixel of 288 rows; 0: without OpenCV
    depth_weight: NonNegative = 0.04  # of depth at first; 0: none
    depth_source: DepthSource = "sweeps"  # depth of what stands still by plane sweeps, or files of depth
    prior_interval: PositiveShare = 0.06  # share of the budget after which flow and depth weigh a tenth, 30k of 500k


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers; `NSFF.preset` has those of a plain CPU."""

    backbone: BackboneNumbers = BackboneNumbers(final_learning_rate=5e-6)
    rays: EvenNumbers = EvenNumbers()
    flow: FlowNumbers = FlowNumbers()
    static_field: bool = True  # a static field beside the dynamic one; off: the dynamic one shows everything


SOURCES = {  # of the numbers of `paper`; the others are ours
    "zhengqili/Neural-Scene-Flow-Fields, nsff_exp/configs/config_kid-running.txt (d400175)": (
        "samples rays_per_step hidden_width neighbours cycle_weight smooth_weight flow_weight depth_weight "
        "prior_interval"
    ),
    "zhengqili/Neural-Scene-Flow-Fields, nsff_exp/run_nerf.py (d400175)": (
        "field depth position_frequencies direction_frequencies learning_rate static_field both_ways max_flow "
        "occlusion_weight"
    ),
}


class Hop(NamedTuple):
    """Samples of rays, warped to another time, with the dynamic field there.

    places, time: of the samples; motion: raw, of the dynamic field there
    """

    places: Points
    time: Float[Tensor, "sample 2"]
    density: Densities
    rgb: Float[Tensor, "sample 3"]
    motion: Float[Tensor, "sample 8"]


class NSFF(FieldMethod):
    """A static field, and a dynamic one with forward and backward scene flow at each point and time."""

    Config, further_bytes, learning_rate = Config, staticmethod(sampling_bytes), held_decay
    network: BlendedField
    known_moments: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        b, space = c.backbone, space_of(frame)
        self.space, moments = space, max(frame.train_count or frame.image_count, 2)
        self.sampler = b.sampler(frame, space) if b.hashed else EvenSampler(space, c.rays)
        with seeded(c.seed):
            static = b.build(frame, space, StaticHash, partial(NetworkField, inputs=3, heads=1))
            kinds = partial(TimeHash, moments=moments), partial(NetworkField, inputs=4, heads=8)
            dynamic = b.build(frame, space, *kinds)
        self.network = BlendedField(static if c.static_field else None, dynamic)
        self.warps = c.flow.neighbours > 0 and frame.times is not None
        if not self.warps:
            for parameter in (dynamic.motion if b.hashed else dynamic.heads).parameters():
                parameter.requires_grad_(False)
        flows = self.warps and c.flow.flow_weight > 0
        source = c.flow.depth_source if self.warps and c.flow.depth_weight else None
        self.priors = MotionPriors(frame.image_count, flows, source)
        rows = max(frame.image_count, 2)
        self.register_buffer("known_moments", torch.linspace(*(frame.times or (0.0, 1.0)), rows))
        self.prior_scale, self.chains = 1.0, False

    @classmethod
    def cpu_preset(cls) -> Any:
        """Hash tables instead of networks, one neighbour in a step, fewer levels, samples and cells."""
        return changed(changed(Config(), **CPU_BACKBONE), learning_rate=1e-2, levels=6, max_resolution=192,
            steps_per_diagonal=192, samples_per_step=1 << 13, occupancy_resolution=64, both_ways=False, neighbours=1,
            max_flow=0.3, prior_interval=0.3)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """Tiny tables, within some twenty quick steps."""
        return changed(Config(), **TINY_BACKBONE, both_ways=False, max_flow=0.3, prior_interval=0.3)

    # Codes: a time from 0 to 1, and what is added to the blending weight

    def code_at(self, times: Float[Tensor, " n"]) -> Float[Tensor, "n 2"]:
        """Codes of times of the capture, blended by the control."""
        first, last = self.frame.times or (0.0, 1.0)
        shift = 0.0 if self.training else float(self.settings.get("field", 0.0))
        return torch.stack([(times - first) / max(last - first, 1e-9), torch.full_like(times, shift)], 1)

    def code(self, rays: Rays) -> Float[Tensor, "ray 2"]:
        return self.code_at(self.moments(rays))

    @property
    def shown_code(self) -> Float[Tensor, "1 2"]:
        first, _ = self.frame.times or (0.0, 0.0)
        return self.code_at(torch.full((1,), float(self.settings.get("time", first)), device=self.device))

    @property
    def controls(self) -> tuple[Control, ...]:
        if self.frame.times is None:
            return super().controls
        blend = "Shows the dynamic field alone at -1, the static one alone at 1, and both as learnt at 0."
        field = (Control("field", 0.0, (-1.0, 1.0), about=blend),) if self.config.static_field else ()
        return *super().controls, moment(self.frame.times), *field

    def density(self, points: Points) -> Densities:
        return self.network.density(points, self.shown_code.expand(len(points), -1))

    def density_in_training(self, generator: torch.Generator) -> Density:
        """Density of each point at a random moment."""
        return lambda points: self.network.density(points, self.code_at(self.random_times(points, generator)))

    # Learning

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        if data.cameras.time is not None:
            found = data.cameras.time[data.splits["train"]].unique()
            self.known_moments.fill_(math.inf)
            self.known_moments[: len(found)] = found.to(self.device)
        super().begin(data, seconds)

    def batch(self, data: Scene, generator: torch.Generator) -> Batch:
        return data.sample_rays(self.sampler.batch_size, generator, places=True).to(self.device)

    def before_step(self, step: int, progress: float) -> None:
        """Weights of flow and depth decay by a factor of ten each time; from the first decay on, warps reach the
        second neighbour."""
        falls = int(progress / self.config.flow.prior_interval)
        self.prior_scale, self.chains = PRIOR_FALL**-falls, falls > 0 and self.config.flow.neighbours > 1
        super().before_step(step, progress)

    def loss(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """The squared errors of the blended field and of the dynamic one alone (eqs. 5 and 11), and, of each way to a
        neighbouring moment, those of `warped`."""
        generator, c = self.random(step), self.config.flow
        (samples,), terms = self.learn(batch.rays, generator)
        background = backdrop(batch, self.background, generator, self.sampler.is_open)
        target, packed = batch.before(background), samples.samples
        both, moving = self.network.colours(samples.features, samples.directions)
        density = samples.features[2][:, 1]
        blended = composite(packed, samples.density, both, background)
        terms["blended"] = (blended.rgb - target).square().mean()
        self.figures["mse"] = float(terms["blended"].detach())
        if self.network.static is not None:
            dynamic = composite(packed, density, moving, background)
            terms["dynamic"] = (dynamic.rgb - target).square().mean()
        if not self.warps:
            return terms
        points = batch.rays.origins[packed.ray_index] + packed.t[:, None] * samples.directions
        code = samples.code_of_samples(self.code(batch.rays))
        assert code is not None
        motion = self.network.dynamic.raw_heads(samples.features[0], points, code)
        start = Hop(points, code, density, moving, motion)
        if c.both_ways:
            ways = [torch.full((len(target),), way, device=self.device) for way in (0, 1)]
        else:
            ways = [torch.randint(2, (len(target),), generator=generator).to(self.device)]
        for way in ways:
            for name, term in self.warped(batch, packed, samples.directions, start, way, target, background).items():
                terms[name] = terms.get(name, 0.0) + term / len(ways)
        forward, back = self.flows(motion)
        between = packed.ray_index.diff() == 0
        near = torch.exp(-NEIGHBOURS * points.diff(dim=0).norm(dim=-1))
        unlike = near * (forward.diff(dim=0).abs() + back.diff(dim=0).abs()).sum(-1)
        terms["smooth"] = SMOOTH_WEIGHT * (seen(between, unlike) + (forward + back).square().sum(-1).mean() / 2)
        terms["least"] = MIN_WEIGHT * (forward.abs().mean() + back.abs().mean())
        if len(self.priors.depth.rows) and self.prior_scale > LAST_SCALE:
            terms["depth"] = c.depth_weight * self.prior_scale * self.depth_error(batch, packed, density, moving)
        return terms

    def flows(self, motion: Float[Tensor, "sample 8"]) -> tuple[Float[Tensor, "sample 3"], Float[Tensor, "sample 3"]]:
        """Flow to the next moment, and to the one before, in coordinates of the space."""
        forward, back = (self.config.flow.max_flow * motion[:, :6].tanh()).split(3, 1)
        return forward, back

    def toward(self, motion: Float[Tensor, "sample 8"], way: Int[Tensor, " sample"]) -> tuple[Tensor, Tensor]:
        """Flow and disocclusion weight of samples, each in its direction: 1 to the next time, 0 to the previous one."""
        forward, back = self.flows(motion)
        ahead = way[:, None] > 0
        return torch.where(ahead, forward, back), torch.where(ahead, motion[:, 6:7], motion[:, 7:8]).sigmoid()

    def hop(self, start: Hop, way: Int[Tensor, " sample"], time: Tensor, directions: Directions) -> tuple[Hop, Tensor]:
        """Samples at a neighbouring time, and their disocclusion weights towards it. time: code of that time"""
        flow, weight = self.toward(start.motion, way)
        places = self.space.unwarp(self.space.warp(start.places) + flow)
        density, features = self.network.dynamic.geometry(places, time)
        rgb = self.network.dynamic.colour(features, directions)
        motion = self.network.dynamic.raw_heads(features, places, time)
        return Hop(places, time, density, rgb, motion), weight

    def warped(
        self,
        batch: Batch,
        packed: Samples,
        directions: Directions,
        start: Hop,
        way: Int[Tensor, " ray"],
        target: Float[Tensor, "ray 3"],
        background: Float[Tensor, "#ray 3"],
    ) -> dict[str, Tensor]:
        """Photometric consistency (eqs. 4 to 6), cycle consistency (eq. 7) and optical flow (eq. 8) of rays warped to a
        neighbouring time, each in its direction, and on to the second neighbour."""
        c, ray = self.config.flow, packed.ray_index
        count = int(self.known_moments.isfinite().sum())
        index = torch.searchsorted(self.known_moments, self.moments(batch.rays).contiguous()).clamp(max=count - 1)
        terms = dict[str, Tensor]()
        known = torch.ones_like(index, dtype=torch.bool)
        weight_so_far, at = packed.t.new_ones(len(packed), 1), start
        for hop in range(2 if self.chains else 1):
            index = index + 2 * way - 1
            known = known & (index >= 0) & (index < count)
            time = self.code_at(self.known_moments[index.clamp(0, count - 1)])[ray]
            there, weight = self.hop(at, way[ray], time, directions)
            weight_so_far = weight_so_far * weight
            picture = composite(packed, there.density, there.rgb, background, weight=weight_so_far)
            certain = picture.extra["weight"][:, 0] + 1 - picture.opacity
            flow, (back, _) = self.toward(at.motion, way[ray])[0], self.toward(there.motion, 1 - way[ray])
            error = seen(known, certain * (picture.rgb - target).square().mean(-1))
            values = {  # of both ways the mean weighted by certainty, as the release's; of one way the mean
                "photometric": error / seen(known, certain).clamp_min(1e-6) if c.both_ways else error,
                "occlusion": OCCLUSION_WEIGHT * seen(known[ray], 1 - weight[:, 0]),
                "cycle": CYCLE_WEIGHT * seen(known[ray], weight[:, 0] * (flow + back).abs().mean(-1)),
            }
            if not hop and len(self.priors.flow.rows) and self.prior_scale > LAST_SCALE:
                own = composite(packed, at.density, at.rgb, None, place=there.places)
                error = self.flow_error(batch, way, known, own)
                values["flow"] = c.flow_weight * self.prior_scale * error
            for name, value in values.items():
                terms[name] = terms[name] + value if name in terms else value
            at = there
        return terms

    def flow_error(self, batch: Batch, way: Int[Tensor, " ray"], known: Tensor, own: Rendering) -> Float[Tensor, ""]:
        """Distance in pixels between projected scene flow and optical flow (eq. 8), of pictures 288 rows high.

        own: of the dynamic field at the rays' time; its extra `place` is the displaced position of its samples
        """
        goal, image = self.priors.flow_targets(batch, way)
        sure = (known & (own.opacity > MIN_OPACITY) & goal.isfinite().all(-1) & (image >= 0)).nonzero()[:, 0]
        image = image[sure]
        found, visible = self.priors.cameras.project(own.extra["place"][sure] / own.opacity[sure, None], image)
        error = (found - goal[sure]).abs().mean(-1) * ROWS / self.priors.cameras.size[image, 1]
        return seen(visible, error)

    def depth_error(
        self, batch: Batch, packed: Samples, density: Densities, rgb: Float[Tensor, "sample 3"]
    ) -> Float[Tensor, ""]:
        """Relative error of the dynamic field's depth (eq. 8), where depth is known."""
        known = self.priors.depth_targets(batch)
        depth = composite(packed, density, rgb).depth
        sure = known.isfinite() & (known > 0) & depth.isfinite()
        return seen(sure, (torch.where(sure, depth, 1.0) / torch.where(sure, known, 1.0) - 1).abs())

    def optimizers(self) -> list[torch.optim.Optimizer]:
        fields = [x for x in (self.network.static, self.network.dynamic) if x is not None]
        return [
            *(o for x in fields for o in x.optimizers_at(self.config.backbone.learning_rate)),
            *super().optimizers(),
        ]

    # Motion

    @torch.no_grad()
    def follow(self, points: Points, start: float, end: float) -> Points:
        """Positions at one time of surface points of another, by integrating scene flow."""
        moments = self.known_moments[self.known_moments.isfinite()].tolist()
        if not self.warps or len(moments) < 2:
            return points
        ahead, time = end > start, start
        between = [m for m in (moments if ahead else moments[::-1]) if min(start, end) < m < max(start, end)]
        for stop in [*between, end]:
            code = self.code_at(points.new_full((len(points),), time))
            _, features = self.network.dynamic.geometry(points, code)
            forward, back = self.flows(self.network.dynamic.raw_heads(features, points, code))
            gap = next((b - a for a, b in zip(moments, moments[1:], strict=False) if b > time or b == moments[-1]))
            share = abs(stop - time) / gap
            points = self.space.unwarp(self.space.warp(points) + share * (forward if ahead else back))
            time = stop
        return points
