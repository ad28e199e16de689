"""Splat SLAM: tracking and mapping of a depth camera by Gaussians (SplaTAM, Keetha et al. 2024, arXiv 2312.02126)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from .. import kernels
from ..budget import BY_PHOTOGRAPH, Efforts
from ..camera import Camera
from ..camera.rays import Rendering
from ..color.blending import before, over
from ..components.clouds.cloud import Cloud, RateNumbers
from ..components.tracking.alignment import COLOUR_DEVIATION, aligned
from ..components.tracking.frames import DepthFrame, Moment
from ..components.tracking.tracker import ALIGNMENT_ITERATIONS, ALIGNMENT_POINTS, Iterations, Tracker, TrackingNumbers
from ..components.tracking.trajectory import Pose, apply_twists
from ..datasets.scene import Frame, Scene
from ..errors import LumigraphWarning
from ..files.ranges import CloudSize, Count, between, changed
from ..gaussians import Gaussians
from ..gaussians.cloud import joined
from ..gaussians.splatting import Splatted, render, splat, view_of
from ..kernels.spherical_harmonics import K00
from ..method import BaseConfig, Descend, Method

RADIUS_RATIO = 3.0  # farthest depth of the first frame over the scene's radius, in the release
MAX_RADIUS = 0.1  # of the scene's radius: larger Gaussians are pruned
PRUNE_OPACITY = 0.005  # below which a Gaussian is pruned
PRUNE_ITERATIONS = 0, 20  # iterations of a frame's mapping before which Gaussians are pruned
DEPTH_ERROR_FACTOR = 50.0  # lambda, medians of the depth error beyond which a surface is new (section 3.3)
NEW_SILHOUETTE = 0.5  # below which a pixel's surface is new (section 3.3)
OVERLAP_PIXELS = 1600  # of a frame, by which its overlap with keyframes is measured
OVERLAP_BORDER = 20 / 640  # of a keyframe's width, within which points do not count
MIN_COVERED = 0.1  # share of a frame's measured pixels that the map must cover to explain it
DEPTH_TOLERANCE = 0.1  # relative error of depth up to which a pixel is explained
TRUNCATION = 0.1  # metres from the rendered surface within which points are aligned with it
NORMAL_STEP = 2  # pixels between the points that a rendered normal is made of
ROTATION_RATE = 8e-4  # Adam's rate of a pose's rotation, radians: 4e-4 of a quaternion
SHIFT_RATE = 2e-3  # Adam's rate of a pose's shift, metres
TRACKING_SILHOUETTE = 0.99  # silhouette from which on a pixel counts in tracking
DEPTH_WEIGHT = 1.0  # weight of depth, metres
COLOUR_WEIGHT = 0.5  # weight of colours
SSIM_WEIGHT = 0.2  # share of D-SSIM in the loss of colours, in mapping alone


@dataclass(frozen=True)
class SplatPoseNumbers:
    """A Config's numbers of a frame's pose (section 3.2)."""

    tracking_iterations: Iterations = 40  # descents on a frame's pose; more follow faster motion, slower


@dataclass(frozen=True)
class SplatMappingNumbers:
    """A Config's numbers of densification and mapping (sections 3.3 and 3.4)."""

    mapping_iterations: Iterations = 60  # descents on the map for each frame; more learn more, slower
    first_iterations: Iterations = 60  # descents on the map for the first frame
    window: Annotated[int, between(2, 1000)] = 24  # frames k of a frame's mapping: itself, the latest keyframe, others
    keyframe_every: Count = 5  # frames from one keyframe to the next


@dataclass(frozen=True)
class Config(BaseConfig):
    """The numbers of the paper and of its release for Replica."""

    tracking: TrackingNumbers = TrackingNumbers()
    descent: SplatPoseNumbers = SplatPoseNumbers()
    mapping: SplatMappingNumbers = SplatMappingNumbers()
    rates: RateNumbers = RateNumbers(means_lr=1e-4, final_means_lr=1e-4, sh_lr=2.5e-3 / K00, scales_lr=1e-3)
    frame_side: Annotated[int, between(0, 10_000)] = 0  # pixels of the longer side of frames, about; 0 as photographs
    max_gaussians: CloudSize = 4_000_000  # Gaussians at most; what is seen after that is not mapped


SOURCES = {  # of the numbers of `paper`; the others are ours
    "spla-tam/SplaTAM, configs/replica/splatam.py (da6bbcd)": (
        "first_estimate tracking_iterations rotation_rate shift_rate tracking_silhouette mapping_iterations "
        "first_iterations window keyframe_every depth_weight colour_weight means_lr final_means_lr sh_lr opacities_lr "
        "scales_lr frame_side"
    ),
    "spla-tam/SplaTAM, scripts/splatam.py (da6bbcd)": "ssim_weight",
}


class SplatSlam(Method):
    """One step is one frame: estimate its pose by gradient descent through the Gaussians, add Gaussians in newly seen
    regions, then optimise all of them. Gaussians are isotropic with one colour. Steps after the last frame continue
    mapping.

    radius: of the scene, scene units; 0 before the first frame
    anchor: image at which each Gaussian was added
    """

    Config = Config
    efforts: ClassVar[Efforts] = BY_PHOTOGRAPH
    idle_render_share: ClassVar[float] = 0.2  # a map that grows while one walks is looked at
    grows: ClassVar[tuple[str, ...]] = ("anchor",)
    radius: Tensor
    anchor: Tensor

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        self.unit = 1 / frame.to_source.scale  # scene units of a metre
        self.cloud = Cloud(balls(torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 3)), c.rates)
        self.cloud.quaternions.requires_grad_(False)
        self.cloud.extent.fill_(self.unit)  # the means' rate is in metres
        self.tracker = Tracker(frame.image_count, c.tracking, self.unit, c.frame_side)
        self.register_buffer("radius", torch.tensor(0.0))
        self.register_buffer("anchor", torch.zeros(0, dtype=torch.int64))
        self.rehearses = False

    @classmethod
    def cpu_preset(cls) -> Any:
        """Small frames, aligned with the rendered surface first; few descents."""
        return changed(
            Config(), first_estimate="surface", tracking_iterations=5, mapping_iterations=8, first_iterations=40,
            window=10, means_lr=1e-3, final_means_lr=1e-3, sh_lr=2e-2, scales_lr=5e-3, frame_side=160)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """Few descents a frame."""
        return changed(
            Config(), tracking_iterations=4, mapping_iterations=2, first_iterations=2, window=4, keyframe_every=2,
        )  # fmt: skip

    # The sequence

    def steps_per_pass(self, data: Any) -> float:
        return len(self.tracker.sequence(data))

    def compile_begin(self) -> None:
        super().compile_begin()
        self.rehearses = True

    def batch(self, data: Scene, generator: torch.Generator) -> Moment:
        """The frame that is next, and the scene."""
        return self.tracker.moment(data)

    def step(self, batch: Moment, step: int, descend: Descend) -> dict[str, Tensor]:
        """Follow the next frame, densify where it sees something new, then map."""
        c, chance, frame, tracker = self.config.mapping, self.random(step), batch.frame, self.tracker
        self.figures, first = {}, int(tracker.turn) == 0
        iterations = 1 if self.rehearses else max(c.first_iterations if first else c.mapping_iterations, 1)
        if frame is not None:
            share = tracker.follow(frame, batch, lambda seen, pose: self.tracked(seen, pose, chance), self.explained)
            if share is None or not (batch.scene.splits["train"] == frame.index).any():
                frame = None
            else:
                self.figures["explained"] = share
                self.densify(frame, first)
        window = self.window(frame, batch, chance)
        terms = self.map(window, iterations, chance, descend) if window else {}
        if frame is not None and (len(tracker.keyframes) * c.keyframe_every <= self.mapped(batch, frame)):
            tracker.add_keyframe(frame)
            before = tracker.trajectory.poses.clone()
            if tracker.close_loop(frame, batch.scene):
                self.carry(before)
        self.figures |= {"gaussians": len(self.cloud), "keyframes": len(tracker.keyframes)}
        return terms

    def mapped(self, moment: Moment, frame: DepthFrame) -> int:
        """Number of frames before this one that may be mapped."""
        learnt = set(moment.scene.splits["train"].tolist())
        return sum(index in learnt for index in moment.before)

    # The map

    def gaussians(self) -> Gaussians:
        """Balls: one deviation for all axes (section 3.1)."""
        c = self.cloud.gaussians()
        scales = c.log_scales.mean(-1, keepdim=True).expand(-1, 3)
        return replace(c, quaternions=c.quaternions.detach(), log_scales=scales)

    def seen(self, cloud: Gaussians, frame: DepthFrame, pose: Pose) -> Splatted:
        """Colour, depth in scene units along the axis, and silhouette of the map from a pose, differentiable in both:
        isotropic Gaussians without view dependence transform into the camera's frame by their centres alone (eqs. 2 to
        5)."""
        there = replace(cloud, means=(cloud.means - pose[:, 3]) @ pose[:, :3])
        return splat(there, view_of(frame.camera, self.near_plane), 1)

    @property
    def near_plane(self) -> float:
        return 0.1 * self.frame.near

    def pose(self, frame: DepthFrame) -> Pose:
        return self.tracker.trajectory.poses[frame.index]

    @torch.no_grad()
    def explained(self, frame: DepthFrame, pose: Pose) -> float:
        """Share of the measured pixels that the map covers with depth explained by it; of a tenth of all at least."""
        depth, known = axial(frame)
        seen = self.seen(self.gaussians(), frame, pose)
        there = known & (seen.opacity > NEW_SILHOUETTE)
        right = there & ((surface_depth(seen) - depth).abs() < DEPTH_TOLERANCE * depth)
        return float(right.sum() / there.sum().clamp_min(MIN_COVERED * known.sum()).clamp_min(1))

    # Tracking (section 3.2)

    def tracked(self, frame: DepthFrame, pose: Pose, chance: torch.Generator) -> Pose:
        """The frame's pose: aligned with the rendered surface, or as given, then the best of descents on

        L = sum over S > 0.99 of |D - D^| + 0.5 |C - C^|                                            (eq. 8)
        """
        t = self.config.descent
        with torch.no_grad():
            cloud, (depth, known) = self.gaussians(), axial(frame)
        if self.config.tracking.first_estimate == "surface":
            pose = self.surface_aligned(cloud, frame, pose, chance)
        rgb, best, found = self.target(frame), math.inf, pose
        turn, shift = (torch.zeros(1, 3, device=self.device, requires_grad=True) for _ in range(2))
        groups = [{"params": [turn], "lr": ROTATION_RATE}, {"params": [shift], "lr": SHIFT_RATE}]
        optimizer = torch.optim.Adam(groups)
        for _ in range(1 if self.rehearses else t.tracking_iterations):
            at = apply_twists(pose[None], torch.cat([turn, shift * self.unit], -1))[0]
            seen = self.seen(cloud, frame, at)
            sure = known & (seen.opacity.detach() > TRACKING_SILHOUETTE)
            away = DEPTH_WEIGHT * (surface_depth(seen) - depth).abs() / self.unit
            error = away + COLOUR_WEIGHT * (self.shown(seen) - rgb).abs().sum(-1)
            loss = torch.where(sure, error, 0.0).sum() / sure.sum().clamp_min(1)
            if (value := loss.item()) < best:
                best, found = value, at.detach()
            turn.grad, shift.grad = torch.autograd.grad(loss, [turn, shift])
            optimizer.step()
        return found

    def surface_aligned(self, cloud: Gaussians, frame: DepthFrame, pose: Pose, chance: torch.Generator) -> Pose:
        """The pose at which measured points lie on the surface that is rendered from the first estimate."""
        sure = TRACKING_SILHOUETTE
        with torch.no_grad():
            seen = self.seen(cloud, frame, pose)
            surface, normals, there = surface_of(frame, seen, sure)
        image = torch.cat([surface, normals, self.shown(seen), there.float()[..., None]], -1).permute(2, 0, 1)[None]
        size, camera = torch.tensor(frame.size, device=self.device), frame.camera

        def field(world: Float[Tensor, "point 3"]) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
            local = (world - pose[:, 3]) @ pose[:, :3]
            pixels, valid = camera.project(local)
            place = (2 * pixels / size - 1)[None, None]
            values = grid_sample(image, place, align_corners=False)[0, :, 0].T
            distance = ((local - values[:, :3].detach()) * normalize(values[:, 3:6].detach(), dim=-1)).sum(-1)
            inside = valid & (values[:, 9] > 0.99)
            return torch.where(inside, distance / (TRUNCATION * self.unit), 2.0), values[:, 6:9]

        pixels = frame.sample_pixels(ALIGNMENT_POINTS, chance, measured=True)
        points, deviation = frame.points(pixels), frame.deviation[pixels] / (TRUNCATION * self.unit)
        rgb, steps = frame.rgb[pixels], ALIGNMENT_ITERATIONS
        return aligned(field, pose, points, rgb, deviation, COLOUR_DEVIATION, self.unit, steps).pose

    # Densification (section 3.3)

    @torch.no_grad()
    def densify(self, frame: DepthFrame, first: bool) -> None:
        """Add a Gaussian at each measured pixel of a mask, with the radius of a pixel there: r = D / f (section 3.3).

        M = (S < 0.5) + (D < D^) (|D - D^| > 50 median |D - D^|)                                         (eq. 9)
        """
        c, pose, (depth, known) = self.config, self.pose(frame), axial(frame)
        if first:
            self.radius.copy_(depth[known].amax() / RADIUS_RATIO if known.any() else torch.tensor(1.0))
        seen = self.seen(self.gaussians(), frame, pose)
        shown = surface_depth(seen)
        error = torch.where(known, (shown - depth).abs(), 0.0)
        median = error[known].median() if known.any() else 0.0
        new = (seen.opacity < NEW_SILHOUETTE) | (depth < shown) & (error > DEPTH_ERROR_FACTOR * median)
        chosen = (new & known).flatten().nonzero()[:, 0]
        room = c.max_gaussians - len(self.cloud)
        if len(chosen) > room:
            warnings.warn(
                f"The map has {c.max_gaussians:,} Gaussians, so new surfaces are left out; give more by "
                "--max-gaussians, or frames that are smaller by --frame-side",
                LumigraphWarning,
                stacklevel=2,
            )
            chosen = chosen[:: math.ceil(len(chosen) / room)] if room > 0 else chosen[:0]
        if not len(chosen):
            return
        points = frame.points(chosen) @ pose[:, :3].T + pose[:, 3]
        deviation = depth.flatten()[chosen] / view_of(frame.camera).focal.mean()
        added = balls(points, deviation, self.target(frame).flatten(0, 1)[chosen])
        self.add(added, frame.index)

    def add(self, added: Gaussians, image: int) -> None:
        """Append Gaussians to the map; `map` begins with fresh moments."""
        self.cloud.replace(joined([self.cloud.gaussians(), added]))
        self.anchor = torch.cat([self.anchor, torch.full((len(added),), image, device=self.device)])

    @torch.no_grad()
    def carry(self, before: Float[Tensor, "image 3 4"]) -> None:
        """Move each Gaussian with the frame at which it was added. before: previous poses of all images"""
        old, new = before[self.anchor], self.tracker.trajectory.poses[self.anchor]
        local = torch.einsum("nji,nj->ni", old[:, :, :3], self.cloud.means - old[:, :, 3])
        self.cloud.means.copy_(torch.einsum("nij,nj->ni", new[:, :, :3], local) + new[:, :, 3])

    # Mapping (section 3.4)

    def window(self, frame: DepthFrame | None, moment: Moment, chance: torch.Generator) -> list[DepthFrame]:
        """Frames of this step's mapping: the current one, the latest keyframe, and the keyframes that overlap most with
        the current one; after the last frame keyframes at random."""
        tracker, k = self.tracker, self.config.mapping.window
        keyframes = tracker.keyframes
        if frame is None:
            order = torch.randperm(len(keyframes), generator=chance)[:k]
            return [tracker.load_keyframe(moment.scene, keyframes[i]) for i in order.tolist()]
        others = keyframes[:-1]
        if len(others) > k - 2:
            shares = self.overlaps(frame, [tracker.load_keyframe(moment.scene, i) for i in others], chance)
            best = torch.tensor(shares).argsort(descending=True, stable=True)[: k - 2]
            others = [others[i] for i in best.tolist()]
        return [frame, *(tracker.load_keyframe(moment.scene, i) for i in [*others, *keyframes[-1:]])]

    @torch.no_grad()
    def overlaps(self, frame: DepthFrame, others: Sequence[DepthFrame], chance: torch.Generator) -> list[float]:
        """Share of a frame's measured points that each of other frames sees."""
        pixels, pose = frame.sample_pixels(OVERLAP_PIXELS, chance, measured=True), self.pose(frame)
        points = frame.points(pixels) @ pose[:, :3].T + pose[:, 3]
        shares = []
        for other in others:
            camera = replace(other.camera, pose=self.pose(other)[None])
            places, valid = camera.project(points)
            border, size = OVERLAP_BORDER * other.size[0], places.new_tensor(other.size)
            shares.append(float((valid & ((places > border) & (places < size - border)).all(-1)).float().mean()))
        return shares

    def map(
        self, window: Sequence[DepthFrame], iterations: int, chance: torch.Generator, descend: Descend
    ) -> dict[str, Tensor]:
        """Descend on the Gaussians through frames of the window at random, without a silhouette mask."""
        terms = dict[str, Tensor]()
        if self.cloud.optimizer is not None:
            self.cloud.optimizer.state.clear()  # as the release, which makes a new optimizer for each frame
        for i in range(iterations):
            if i in PRUNE_ITERATIONS:
                self.prune_faint()
            frame = window[int(torch.randint(len(window), (), generator=chance))]
            (depth, known), rgb = axial(frame), self.target(frame)
            seen = self.seen(self.gaussians(), frame, self.pose(frame))
            shown = self.shown(seen)
            away = torch.where(known, (seen.depth - depth).abs(), 0.0).sum() / known.sum().clamp_min(1) / self.unit
            ssim, l1 = kernels.photometric(shown, rgb)
            colour = (1 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1 - ssim)
            terms = {"depth": DEPTH_WEIGHT * away, "colour": COLOUR_WEIGHT * colour}
            self.figures["mse"] = float((shown - rgb).detach().square().mean())
            descend(terms)
        return terms

    @torch.no_grad()
    def prune_faint(self) -> None:
        """Prune Gaussians that are nearly transparent or too large."""
        keep = self.cloud.opacities.sigmoid() >= PRUNE_OPACITY
        keep &= self.cloud.log_scales.mean(-1).exp() <= MAX_RADIUS * self.radius
        if not keep.all():
            self.prune(keep)

    def prune(self, keep: Bool[Tensor, " gaussian"]) -> None:
        """Keep only the Gaussians of a mask."""
        self.cloud.prune(keep)
        self.anchor = self.anchor[keep]

    def target(self, frame: DepthFrame) -> Float[Tensor, "height width 3"]:
        """Colours of a frame before the background."""
        width, height = frame.size
        return before(frame.rgb, frame.alpha, self.background).view(height, width, 3)

    def shown(self, seen: Splatted) -> Float[Tensor, "height width 3"]:
        """Colours of the map before the background."""
        return over(seen.rgb, seen.opacity, self.background[0])

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return self.cloud.optimizers()

    def render(self, camera: Camera) -> Rendering:
        return render(self.gaussians(), camera.to(self.device), self.frame.background, self.near_plane)


def axial(frame: DepthFrame) -> tuple[Float[Tensor, "height width"], Bool[Tensor, "height width"]]:
    """Measured depth along the axis, 0 for none, and a mask of measured pixels."""
    width, height = frame.size
    known = frame.measured & (frame.depth > 0)
    depth = torch.where(known, frame.depth * frame.rays.directions[:, 2], 0.0)
    return depth.view(height, width), known.view(height, width)


def surface_depth(seen: Splatted) -> Float[Tensor, "height width"]:
    """Mean depth of a pixel's surface: rendered depth over the silhouette, which stays a little below 1."""
    return seen.depth / seen.opacity.clamp_min(1e-3)


def surface_of(
    frame: DepthFrame, seen: Splatted, sure: float
) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width 3"], Bool[Tensor, "height width"]]:
    """Points and normals of a rendered surface in the camera's frame, and a mask of pixels with both."""
    width, height = frame.size
    rays = frame.rays.directions.view(height, width, 3)
    points = rays * (surface_depth(seen) / rays[..., 2])[..., None]
    n, normals = NORMAL_STEP, torch.zeros_like(points)
    across = points[n:-n, 2 * n :] - points[n:-n, : -2 * n]
    down = points[2 * n :, n:-n] - points[: -2 * n, n:-n]
    normals[n:-n, n:-n] = normalize(torch.linalg.cross(across, down), dim=-1)
    facing = (normals * rays).sum(-1).abs() > 0.2  # no edges, where a rendered surface goes from front to back
    return points, normals, (seen.opacity > sure) & facing


def balls(
    means: Float[Tensor, "gaussian 3"], deviation: Float[Tensor, " gaussian"], rgb: Float[Tensor, "gaussian 3"]
) -> Gaussians:
    """Half-opaque balls of one colour each."""
    count = len(means)
    return Gaussians(
        means,
        torch.tensor([1.0, 0.0, 0.0, 0.0]).to(means).repeat(count, 1),
        deviation.log()[:, None].repeat(1, 3),
        torch.zeros(count).to(means),
        ((rgb - 0.5) / K00)[:, None],
    )
