"""Frames of a depth camera for tracking: rays in the camera's frame, colour and distance of each pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...camera import Camera
from ...camera.rays import Rays
from ...datasets.scene import Scene
from ...method.depth import DEPTH_LAYER, DEVIATION_LAYER
from .alignment import GREY, level_step, sensor_deviation
from .trajectory import Pose

COMPARED_POINTS = 2000  # pixels of a frame that are compared with another's depth
COMPARED_DEVIATIONS = 3.0  # of the depth, within which two measurements agree
MIN_AGREEMENT = 0.65  # share of common points that must agree
MISSED = 0.2  # of luminance, for a point that is not on the other's depth
MIN_COMMON = 0.2  # share of a frame's points in common with another, below which they are not compared


@dataclass(frozen=True)
class Comparison:
    """Shares of a frame's points that are in another's picture, on its depth, and in front of that.

    error: mean difference of luminance, MISSED for points that are not on its depth
    """

    common: float
    near: float
    front: float
    error: float = math.inf

    @property
    def contradiction(self) -> float:
        """Share of points in front of the other's depth, where that saw nothing, among those on it or in front."""
        return self.front / max(self.near + self.front, 1e-9)

    @property
    def agrees(self) -> bool:
        return self.common >= MIN_COMMON and self.near > MIN_AGREEMENT * self.common


@dataclass(frozen=True)
class DepthFrame:
    """One frame. Rays are those of a camera at the origin; pixels are row by row.

    depth: distance along the ray, scene units; NaN for unmeasured, or without depth
    alpha: opacity, for photographs with alpha
    size:  (width, height) of the picture
    unit:  scene units of a metre
    stated: standard deviation of the depth, where the recording says it
    """

    index: int
    camera: Camera
    rays: Rays
    rgb: Float[Tensor, "pixel 3"]
    depth: Float[Tensor, " pixel"]
    alpha: Float[Tensor, " pixel"] | None
    size: tuple[int, int]
    unit: float = 1.0
    stated: Float[Tensor, " pixel"] | None = None

    @staticmethod
    def of(scene: Scene, index: int, device: torch.device, like: DepthFrame | None = None, side: int = 0) -> DepthFrame:
        """Load a frame. like: another frame, whose rays are reused for the same lens; side: longer side in pixels,
        about, to which a larger photograph is reduced by an integer; 0 for the photograph's own size"""
        layers = [name for name in (DEPTH_LAYER, DEVIATION_LAYER) if name in scene.layers]
        photograph = scene.photograph(index, layers)
        reduction = max(1, round(int(photograph.camera.size.max()) / side)) if side else 1
        photograph = photograph.reduced(reduction).to(device)
        camera = replace(photograph.camera, pose=torch.eye(3, 4, device=device)[None])
        same = like is not None and same_lens(like.camera, camera)
        rays = like.rays if like is not None and same else camera.rays(camera.pixels())
        extra = {name: values.flatten() for name, values in photograph.extra.items()}
        depth = extra.get(DEPTH_LAYER, torch.full((len(rays),), torch.nan, device=device))
        alpha = None if photograph.alpha is None else photograph.alpha.flatten()
        width, height = camera.size[0].tolist()
        rgb, unit = photograph.rgb.flatten(0, 1), 1 / scene.frame.to_source.scale
        return DepthFrame(index, camera, rays, rgb, depth, alpha, (width, height), unit, extra.get(DEVIATION_LAYER))

    @property
    def measured(self) -> Bool[Tensor, " pixel"]:
        return self.depth.isfinite()

    @cached_property
    def step(self) -> Float[Tensor, " pixel"]:
        """Distance of each pixel's depth from the next level where depth has few levels, scene units; else 0."""
        return self.unit * level_step(self.depth * self.rays.directions[:, 2] / self.unit)

    @cached_property
    def deviation(self) -> Float[Tensor, " pixel"]:
        """Standard deviation of the measured depth, scene units: the recording's, else a sensor's; of levels at least
        that of an even distribution between them."""
        own = self.unit * sensor_deviation(self.depth / self.unit)
        own = own if self.stated is None else torch.where(self.stated > 0, self.stated, own)
        return torch.maximum(own, self.step / 12**0.5)

    def points(self, pixels: Int[Tensor, " chosen"]) -> Float[Tensor, "chosen 3"]:
        """Measured points in the camera's frame."""
        return self.rays[pixels].at(self.depth[pixels])

    @torch.no_grad()
    def compared(self, other: DepthFrame, motion: Pose) -> Comparison:
        """Measured points compared with another frame's depth. motion: pose of this camera in the other's frame"""
        pixels = self.sample_pixels(COMPARED_POINTS, torch.Generator().manual_seed(self.index), measured=True)
        if not len(pixels):
            return Comparison(0.0, 0.0, 0.0)
        points = self.points(pixels) @ motion[:, :3].T + motion[:, 3]
        places, inside = other.camera.locate(points)
        place = places[:, 0] * other.size[0] + places[:, 1]
        ahead = other.depth[place] - points.norm(dim=-1)
        off = COMPARED_DEVIATIONS * torch.maximum(self.deviation[pixels], other.deviation[place])
        seen = inside & ahead.isfinite()
        near = seen & (ahead.abs() < off)
        away = ((self.rgb[pixels] - other.rgb[place]) @ self.rgb.new_tensor(GREY)).abs()
        error = torch.where(near, away, MISSED)[seen].mean() if seen.any() else math.inf
        common, on_it, front = (float(x.float().mean()) for x in (seen, near, seen & (ahead >= off)))
        return Comparison(common, on_it, front, float(error))

    def sample_pixels(self, count: int, generator: torch.Generator, measured: bool = False) -> Int[Tensor, " chosen"]:
        """Random pixels; with `measured`, among those with depth."""
        if not measured:
            return torch.randint(len(self.depth), (count,), generator=generator).to(self.depth.device)
        there = self.measured.nonzero()[:, 0]
        return there[torch.randint(max(len(there), 1), (count * bool(len(there)),), generator=generator)]


@dataclass(frozen=True)
class Moment:
    """Input of one step: the next frame, and the scene for earlier frames.

    frame:  None after the last one
    before: images of the previous frames, in order
    """

    unit: ClassVar[str] = "frames"

    scene: Scene
    frame: DepthFrame | None
    before: list[int]

    def __len__(self) -> int:
        return 1


def same_lens(a: Camera, b: Camera) -> bool:
    return a.lens.to_json() == b.lens.to_json() and torch.equal(a.size, b.size)


def order_of(cameras: Camera) -> Int[Tensor, " frame"]:
    """Image numbers in order of time, else of their numbers."""
    return torch.arange(len(cameras)) if cameras.time is None else cameras.time.cpu().argsort(stable=True)
