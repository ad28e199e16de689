"""iMAP: tracking and mapping of a depth camera by one small field (Sucar et al. 2021, arXiv 2103.12352)."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...budget import BY_PHOTOGRAPH, Efforts
from ...camera.rays import Rays
from ...color.blending import before
from ...components.fields.hash_field import TINY_TABLE, HashNumbers
from ...components.fields.spaces import Box
from ...components.tracking.alignment import COLOUR_DEVIATION, aligned
from ...components.tracking.frames import DepthFrame, Moment
from ...components.tracking.tracker import ALIGNMENT_ITERATIONS, ALIGNMENT_POINTS, Iterations, Tracker, TrackingNumbers
from ...components.tracking.trajectory import Pose, apply_twists
from ...components.training.pose_refinement import PoseAdam
from ...datasets.scene import Frame, Scene
from ...files.ranges import BatchSize, Layers, LearningRate, NonNegative, Positive, Share, Width, between, changed
from ...method import BaseConfig, FieldMethod, Pass, frozen, seeded
from ...method.method import Descend
from ...volume import composite
from .fields import DistanceTable, MapNetwork
from .sampler import MapSampler, SampleNumbers

FREQUENCY_ROWS = 93  # of B, section 3.1
REGIONS = 8  # along each side of a frame, of which active sampling keeps losses (section 3.4)
UNKNOWN_LOSS = 1.0  # of a region that has not been compared yet
MIN_LOSS = 1e-3  # added to losses, so that each region and keyframe can be drawn
SURFACE_BAND = 0.7  # truncations from a table's surface within which a point is explained
SMOOTH_POINTS, SMOOTH_STEP = 1024, 0.05  # pairs of points of the smoothness term, and metres between them
MIN_VARIANCE = 1e-6  # squared scene units of a ray's depth, below which its certainty does not grow
MIN_OVERLAP = 0.5  # share of points on a keyframe's depth, below which a frame becomes one: features match less
EXPLAINED_PIXELS = 1000  # pixels of a frame by which it is judged
TRACKING_RATE = 3e-3  # Adam's rate of a frame's pose, radians and scene units
TRACKING_PIXELS = 200  # pixels of each of these descents, section 3.4
DEPTH_TOLERANCE = 0.1  # t_D, relative error of depth up to which a pixel is explained
COLOUR_WEIGHT = 5.0  # lambda_p, weight of colours, eq. 7


@dataclass(frozen=True)
class FramePoseNumbers:
    """A Config's numbers of a frame's pose (section 3.3)."""

    tracking_iterations: Iterations = 50  # descents on a frame's pose; more follow faster motion, slower


@dataclass(frozen=True)
class FieldMappingNumbers:
    """A Config's numbers of joint mapping (sections 3.3 and 3.4)."""

    mapping_iterations: Iterations = 10  # descents on map and keyframes' poses for each frame; more learn more, slower
    first_iterations: Iterations = 200  # descents on the map for the first frame, and after a loop was closed
    window: Annotated[int, between(1, 1000)] = 5  # keyframes W of a descent, with the latest and the current one
    pixels_per_frame: BatchSize = 200  # pixels of each frame in the window, section 3.4
    active_sampling: bool = True  # draw pixels and keyframes by their loss, section 3.4; else evenly
    keyframe_pose_rate: LearningRate = 3e-3  # Adam's rate of keyframes' poses; 0: they stay
    keyframe_share: Share = 0.65  # t_P, share of explained pixels below which a frame becomes a keyframe


@dataclass(frozen=True)
class LossNumbers:
    """A Config's weights of the loss; those of a distance are Co-SLAM's (Wang 2023, eqs. 6 to 9)."""

    depth_weight: NonNegative = 1.0  # weight of depth, eq. 6
    distance_weight: NonNegative = 0.0  # weight of the distance within the truncation, with --field hash
    free_weight: NonNegative = 0.0  # weight of free space in front of surfaces, with --field hash
    smooth_weight: NonNegative = 0.0  # weight of differences between neighbours in the table, with --field hash


LAYERS = 4  # hidden layers of the network, section 3.1


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers, by section; those without one are not in the paper."""

    table: HashNumbers = HashNumbers(sh_bands=1)
    rays: SampleNumbers = SampleNumbers()
    tracking: TrackingNumbers = TrackingNumbers()
    descent: FramePoseNumbers = FramePoseNumbers()
    mapping: FieldMappingNumbers = FieldMappingNumbers()
    terms: LossNumbers = LossNumbers()
    field: Literal["network", "hash"] = "network"  # map: the paper's network, or a faster hash table of a distance
    colour_layers: Layers = 2  # hidden layers of the table's colour network; more cost time
    hidden_width: Width = 256  # channels of a hidden layer, section 3.1; wider holds more detail, and costs time
    frequency_deviation: Positive = 25.0  # sigma of the Fourier features, section 3.1; higher holds finer detail
    truncation: Positive = 0.1  # metres at which the distance is truncated, with --field hash
    sharpness: Positive = 10.0  # steepness of density at a surface, per truncation, with --field hash
    learning_rate: LearningRate = 1e-3  # Adam's rate of the map; higher: faster, may diverge


SOURCES = {  # of the numbers of `paper`; the others are ours
    "Sucar 2021, sections 3.1 to 3.4": (
        "field layers hidden_width frequency_deviation coarse_samples fine_samples first_estimate tracking_pixels "
        "window pixels_per_frame active_sampling keyframe_share depth_tolerance colour_weight depth_weight "
        "distance_weight"
    ),
    "Sucar 2021, section 4": "learning_rate keyframe_pose_rate",
}


class IMap(FieldMethod):
    """One step is one frame: estimate its pose in the map, decide whether it is a keyframe, then optimise the map and
    the keyframes' poses jointly. Steps after the last frame continue mapping.

    losses:   last measured loss of each image and region of active sampling; those of keyframes are used
    snapshot: the map at the latest keyframe, for keyframe selection (section 3.4)
    """

    Config = Config
    efforts: ClassVar[Efforts] = BY_PHOTOGRAPH
    idle_render_share: ClassVar[float] = 0.2  # a map that grows while one walks is looked at
    network: MapNetwork | DistanceTable
    sampler: MapSampler
    losses: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        self.unit = 1 / frame.to_source.scale  # scene units of a metre
        space, hashed = Box(frame.bounds, frame.near), c.field == "hash"
        with seeded(c.seed):
            if hashed:
                self.network = DistanceTable(
                    c.table, c.hidden_width, space, c.truncation * self.unit, c.sharpness, c.colour_layers
                )
            else:
                self.network = MapNetwork(LAYERS, c.hidden_width, FREQUENCY_ROWS, c.frequency_deviation)
        self.sampler = MapSampler(space, c.rays, c.truncation * self.unit if hashed else None)
        self.tracker = Tracker(frame.image_count, c.tracking, self.unit)
        self.snapshot = copy.deepcopy(self.network).requires_grad_(False)
        self.register_buffer("losses", torch.full((frame.image_count, REGIONS * REGIONS), UNKNOWN_LOSS))
        self.rehearses = False

    @classmethod
    def cpu_preset(cls) -> Any:
        """Co-SLAM's losses on a hash table (Wang 2023), frames aligned with its surface first."""
        return changed(Config(), field="hash", hidden_width=32, learning_rate=1e-2, levels=8, features_per_level=2,
            log2_hashmap_size=16, max_resolution=512, colour_layers=1, sh_bands=1, coarse_samples=16, fine_samples=10,
            first_estimate="surface", tracking_iterations=0, mapping_iterations=5, window=8, pixels_per_frame=128,
            active_sampling=False, keyframe_pose_rate=2e-4, depth_weight=0.1, distance_weight=10.0, free_weight=10.0,
            smooth_weight=1e-3)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """A tiny hash table and few descents a frame."""
        return changed(Config(table=TINY_TABLE), sh_bands=1, field="hash", hidden_width=16, truncation=0.2,
            sharpness=4.0, learning_rate=2e-2, coarse_samples=12, fine_samples=8, mapping_iterations=1,
            first_iterations=2, window=4, pixels_per_frame=64, keyframe_share=1.0, depth_weight=0.1,
            distance_weight=10.0, free_weight=10.0, smooth_weight=1e-4)  # fmt: skip

    # The sequence

    def steps_per_pass(self, data: Any) -> float:
        return len(self.tracker.sequence(data))

    def compile_begin(self) -> None:
        super().compile_begin()
        self.rehearses = True

    def batch(self, data: Scene, generator: torch.Generator) -> Moment:  # type: ignore[override]
        """The frame that is next, and the scene."""
        return self.tracker.moment(data)

    def step(self, batch: Moment, step: int, descend: Descend) -> dict[str, Tensor]:
        """Follow the next frame, then map."""
        c, chance, frame, afresh = self.config.mapping, self.random(step), batch.frame, int(self.tracker.turn) == 0
        self.figures = {}
        if frame is not None:
            share = self.tracker.follow(
                frame,
                batch,
                lambda seen, pose: self.tracked(seen, pose, chance),
                lambda seen, pose: self.explained(self.network, seen, pose, chance),
            )
            learns = share is not None and bool((batch.scene.splits["train"] == frame.index).any())
            if share is not None:
                self.figures["explained"] = share
            if learns and (
                not self.tracker.keyframes
                or self.tracker.overlap < MIN_OVERLAP
                or self.explained(self.snapshot, frame, self.tracker.trajectory.poses[frame.index], chance)
                < c.keyframe_share
            ):
                self.tracker.add_keyframe(frame)
                self.snapshot.load_state_dict(self.network.state_dict())
                afresh |= self.tracker.close_loop(frame, batch.scene)  # the map follows the corrected poses
            frame = frame if learns else None
        return self.map(
            frame,
            batch,
            1 if self.rehearses else c.first_iterations if afresh else c.mapping_iterations,
            chance,
            descend,
        )

    # Keyframes (section 3.4)

    @torch.no_grad()
    def explained(self, field: Any, frame: DepthFrame, pose: Pose, chance: torch.Generator) -> float:
        """Share P of pixels with depth explained by the map (eq. 9); of a table, with its surface close to the
        measured depth."""
        pixels = frame.sample_pixels(EXPLAINED_PIXELS, chance, measured=True)
        if not len(pixels):
            return 0.0
        rays, depth = self.world_rays(frame.rays[pixels], pose[None]), frame.depth[pixels]
        if isinstance(field, DistanceTable):
            distance = field.distance_of(field.geometry(rays.at(depth))[1])
            return float((distance.abs() < SURFACE_BAND).float().mean())
        pixels = pixels[: self.config.mapping.pixels_per_frame]
        rays, depth = rays[: len(pixels)], depth[: len(pixels)]
        (seen,) = self.sampler.sample(rays, field)
        look = seen.look(field)
        found = composite(look.samples, look.density, look.rgb)
        error = (found.depth * found.opacity).nan_to_num(0, 0) - depth
        return float((error.abs() / depth < DEPTH_TOLERANCE).float().mean())

    # Tracking (section 3.3)

    def tracked(self, frame: DepthFrame, pose: Pose, chance: torch.Generator) -> Pose:
        """The frame's pose: aligned with the map's surface, or as given, then by descents on the loss of its pixels."""
        t = self.config.descent
        with frozen(self.network):
            if self.config.tracking.first_estimate == "surface" and isinstance(self.network, DistanceTable):
                pose = self.aligned(frame, pose, chance)
            twist = torch.zeros(1, 6, device=self.device, requires_grad=True)
            optimizer = PoseAdam([twist], TRACKING_RATE)
            for i in range(t.tracking_iterations):
                optimizer.param_groups[0]["lr"] = TRACKING_RATE * (1 - i / t.tracking_iterations)
                pixels = frame.sample_pixels(TRACKING_PIXELS, chance, measured=True)
                rays = self.world_rays(frame.rays[pixels], apply_twists(pose[None], twist))
                terms, _ = self.errors(rays, frame.rgb[pixels], frame.depth[pixels], chance)
                (twist.grad,) = torch.autograd.grad(torch.stack(list(terms.values())).sum(), [twist])
                optimizer.step()
            return apply_twists(pose[None], twist.detach())[0]

    def aligned(self, frame: DepthFrame, pose: Pose, chance: torch.Generator) -> Pose:
        field = self.network
        assert isinstance(field, DistanceTable)
        pixels = frame.sample_pixels(ALIGNMENT_POINTS, chance, measured=True)
        points, deviation = frame.points(pixels), frame.deviation[pixels] / field.truncation

        def seen(world: Tensor) -> tuple[Tensor, Tensor]:
            _, features = field.geometry(world)
            return field.distance_of(features), field.colour(features, world)  # the direction does not matter

        rgb = frame.rgb[pixels]
        return aligned(seen, pose, points, rgb, deviation, COLOUR_DEVIATION, self.unit, ALIGNMENT_ITERATIONS).pose

    # Mapping (section 3.3)

    def map(
        self, current: DepthFrame | None, batch: Moment, iterations: int, chance: torch.Generator, descend: Descend
    ) -> dict[str, Tensor]:
        """Descend on the map and the poses of keyframes together. current: the frame that joins the keyframes"""
        c, terms = self.config.mapping, dict[str, Tensor]()
        joined = sorted({*self.tracker.keyframes, *([] if current is None else [current.index])})
        numbers, poses = torch.tensor(joined), self.tracker.trajectory.poses[joined]
        twists = torch.zeros(len(joined), 6, device=self.device, requires_grad=self.config.tracking.track)
        optimizer = PoseAdam([twists], c.keyframe_pose_rate)
        for _ in range(iterations):
            window = self.window(joined, current, chance)
            frames = [
                current
                if current and current.index == joined[i]
                else self.tracker.load_keyframe(batch.scene, joined[i])
                for i in window
            ]
            drawn = [(f, self.pixels(f, chance)) for f in frames]
            moving = apply_twists(poses, twists * (numbers != joined[0])[:, None].to(twists))  # the first frame stays
            rays = [self.world_rays(f.rays[p], moving[i][None]) for i, (f, p) in zip(window, drawn, strict=True)]
            rgb = torch.cat(
                [before(f.rgb[p], None if f.alpha is None else f.alpha[p], self.background) for f, p in drawn]
            )
            terms, error = self.errors(joined_rays(rays), rgb, torch.cat([f.depth[p] for f, p in drawn]), chance)
            descend(terms)
            if twists.grad is not None and c.keyframe_pose_rate:
                optimizer.step()
                twists.grad = None
            self.remember(drawn, error)
        if self.config.tracking.track:
            self.tracker.trajectory.correct(numbers, twists.detach() * (numbers != joined[0])[:, None])
        self.figures["keyframes"] = len(self.tracker.keyframes)
        return terms

    def window(self, joined: list[int], current: DepthFrame | None, chance: torch.Generator) -> list[int]:
        """Indices in `joined` of the frames of one iteration: the current and the latest keyframe, others sampled by
        their mean loss or uniformly."""
        latest = [i for i, index in enumerate(joined) if current is not None and index == current.index]
        latest = list(dict.fromkeys([*latest, len(joined) - 1]))
        others = [i for i in range(len(joined)) if i not in latest]
        count = min(len(others), max(self.config.mapping.window - len(latest), 0))
        if not count:
            return latest
        weights = (
            self.losses[[joined[i] for i in others]].mean(-1)
            if self.config.mapping.active_sampling
            else torch.ones(len(others))
        )
        chosen = torch.multinomial(weights.cpu() + MIN_LOSS, count, generator=chance)
        return latest + [others[i] for i in chosen.tolist()]

    def pixels(self, frame: DepthFrame, chance: torch.Generator) -> Int[Tensor, " pixel"]:
        """Pixels of a frame: by the loss of their regions, which share them out (eq. 10), or evenly."""
        count, (width, height) = self.config.mapping.pixels_per_frame, frame.size
        if not self.config.mapping.active_sampling:
            return frame.sample_pixels(count, chance)
        region = torch.multinomial(self.losses[frame.index].cpu() + MIN_LOSS, count, replacement=True, generator=chance)
        place = torch.rand(2, count, generator=chance)
        column = ((region % REGIONS + place[0]) * (width / REGIONS)).long().clamp(max=width - 1)
        row = ((region // REGIONS + place[1]) * (height / REGIONS)).long().clamp(max=height - 1)
        return (row * width + column).to(self.device)

    @torch.no_grad()
    def remember(self, drawn: Sequence[tuple[DepthFrame, Tensor]], error: Float[Tensor, " ray"]) -> None:
        """Store the mean error of the sampled regions."""
        if not self.config.mapping.active_sampling:
            return
        for (frame, pixels), own in zip(drawn, error.split([len(p) for _, p in drawn]), strict=True):
            width, height = frame.size
            region = pixels // width * REGIONS // height * REGIONS + pixels % width * REGIONS // width
            total, count = (torch.zeros(REGIONS * REGIONS, device=own.device) for _ in range(2))
            total.index_add_(0, region, own)
            count.index_add_(0, region, torch.ones_like(own))
            self.losses[frame.index] = torch.where(count > 0, total / count.clamp_min(1), self.losses[frame.index])

    def world_rays(self, rays: Rays, pose: Float[Tensor, "1 3 4"]) -> Rays:
        """Rays of a camera at the origin, for a camera at a pose."""
        turn, place = pose[0, :, :3], pose[0, :, 3]
        return replace(rays, origins=rays.origins @ turn.T + place, directions=rays.directions @ turn.T)

    def errors(
        self, rays: Rays, rgb: Float[Tensor, "ray 3"], depth: Float[Tensor, " ray"], chance: torch.Generator
    ) -> tuple[dict[str, Tensor], Float[Tensor, " ray"]]:
        """Terms of the loss along rays, and the error of each ray's colour and depth, for active sampling.

        rgb: sRGB-encoded, before the background; depth: distance along the ray, NaN where nothing was measured
        """
        c, known = self.config.terms, depth.isfinite()
        (seen,) = self.sampler.sample(rays, self.network, None, chance, depth)
        look, t = seen.look(self.network), seen.samples.t[:, None]
        found = composite(look.samples, look.density, look.rgb, self.background, moments=torch.cat([t, t * t], -1))
        residual, (mean, square) = found.rgb - rgb, found.extra["moments"].unbind(-1)
        away = torch.where(known, mean - depth.nan_to_num(0, 0, 0), 0.0)
        count = known.sum().clamp_min(1)
        self.figures["mse"] = float(residual.detach().square().mean())
        if isinstance(self.network, MapNetwork):  # eqs. 5 to 7
            variance = (square - 2 * mean * mean + mean * mean * found.opacity).detach().clamp_min(MIN_VARIANCE)
            away = away.abs() / variance.sqrt()
            colour, depths = residual.abs().mean(-1), away
        else:  # Wang 2023, eqs. 6 and 7
            colour, depths = residual.square().mean(-1), (away / self.unit).square()
        terms = {"colour": COLOUR_WEIGHT * colour.mean(), "depth": c.depth_weight * depths.sum() / count}
        if isinstance(self.network, DistanceTable):
            terms |= self.distance_terms(self.network, seen, depth, chance)
        if not known.any():
            terms = {"colour": terms["colour"]} | {name: terms[name] for name in ("smooth",) if name in terms}
        return terms, (COLOUR_WEIGHT * colour + c.depth_weight * depths).detach()

    def distance_terms(
        self, field: DistanceTable, seen: Pass, depth: Float[Tensor, " ray"], chance: torch.Generator
    ) -> dict[str, Tensor]:
        """The distance near what was measured, free space before it (Wang 2023, eqs. 8 and 9), smoothness (eq. 10)."""
        c, ray = self.config.terms, seen.samples.ray_index
        ahead = (depth[ray] - seen.samples.t) / field.truncation  # truncations to the surface; NaN where unknown
        assert isinstance(seen.features, Tensor)
        distance = field.distance_of(seen.features)
        near, free = ahead.abs() < 1, ahead >= 1
        error = torch.where(near, distance - ahead.nan_to_num(0, 0, 0), 0.0).square().sum() / near.sum().clamp_min(1)
        clear = torch.where(free, distance - 1, 0.0).square().sum() / free.sum().clamp_min(1)
        terms = {"distance": c.distance_weight * error, "free": c.free_weight * clear}
        if c.smooth_weight:
            low, high = self.background.new_tensor(self.frame.bounds)
            points = torch.lerp(low, high, torch.rand(SMOOTH_POINTS, 3, generator=chance).to(low))
            beside = points + SMOOTH_STEP * self.unit * torch.randn(SMOOTH_POINTS, 3, generator=chance).to(low)
            first, second = field.encode(torch.cat([points, beside])).chunk(2)
            terms["smooth"] = c.smooth_weight * (first - second).square().sum(-1).mean()
        return terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        if isinstance(self.network, DistanceTable):
            return self.network.optimizers_at(self.config.learning_rate)
        return [torch.optim.Adam(self.network.parameters(), self.config.learning_rate)]


def joined_rays(parts: Sequence[Rays]) -> Rays:
    return Rays(*(torch.cat([getattr(x, name) for x in parts]) for name in ("origins", "directions", "radius")))
