"""Frames of a depth camera for tracking: rays in the camera's frame, colour and distance of each pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...camera import Camera
from ...camera.rays import Rays
from ...datasets.scene import Scene


@dataclass(frozen=True)
class DepthFrame:
    """One frame. Rays are those of a camera at the origin; pixels are row by row.

    depth: distance along the ray, scene units; NaN for unmeasured, or without depth
    alpha: opacity, for photographs with alpha
    size:  (width, height) of the picture
    """

    index: int
    camera: Camera
    rays: Rays
    rgb: Float[Tensor, "pixel 3"]
    depth: Float[Tensor, " pixel"]
    alpha: Float[Tensor, " pixel"] | None
    size: tuple[int, int]

    @staticmethod
    def of(scene: Scene, index: int, device: torch.device, like: DepthFrame | None = None, side: int = 0) -> DepthFrame:
        """Load a frame. like: another frame, whose rays are reused for the same lens; side: longer side in pixels,
        about, to which a larger photograph is reduced by an integer; 0 for the photograph's own size"""
        layers = ["depth"] if "depth" in scene.layers else []
        photograph = scene.photograph(index, layers)
        reduction = max(1, round(int(photograph.camera.size.max()) / side)) if side else 1
        photograph = photograph.reduced(reduction).to(device)
        camera = replace(photograph.camera, pose=torch.eye(3, 4, device=device)[None])
        same = like is not None and same_lens(like.camera, camera)
        rays = like.rays if like is not None and same else camera.rays(camera.pixels())
        depth = photograph.extra["depth"].flatten() if layers else torch.full((len(rays),), torch.nan, device=device)
        alpha = None if photograph.alpha is None else photograph.alpha.flatten()
        width, height = camera.size[0].tolist()
        return DepthFrame(index, camera, rays, photograph.rgb.flatten(0, 1), depth, alpha, (width, height))

    @property
    def measured(self) -> Bool[Tensor, " pixel"]:
        return self.depth.isfinite()

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
