"""What a trained method shows to cameras around it, small: where its surfaces are, and where there is nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from ...camera import Camera
from ...choice import evenly
from ...geometry import normals_from_depth
from ...progress import track

VIEWS, LONGEST = 24, 128  # cameras asked at most, and pixels of the longer side of what they see
SOLID, CLEAR = 0.5, 0.02  # opacity from which on a pixel shows a surface, and up to which it shows none
MARGIN = 0.02  # of the distance from the camera: how exactly rendered depth says where a surface is
AROUND = 3  # pixels: of these the nearest surface counts, so that thin things are not seen past
WITNESSES = 2  # cameras that must see past a place for it to be empty


@dataclass(frozen=True)
class Sight:
    """One camera, and what it sees. Rows of pixels, on the CPU.

    rgb:   sRGB-encoded, without the background
    depth: distance along the ray, scene units; infinity where no surface is
    """

    camera: Camera
    rgb: Float[Tensor, "height width 3"]
    depth: Float[Tensor, "height width"]
    opacity: Float[Tensor, "height width"]

    @property
    def solid(self) -> Bool[Tensor, "height width"]:
        """Which pixels show a surface."""
        return (self.opacity > SOLID) & self.depth.isfinite()

    @cached_property
    def nearest(self) -> Float[Tensor, "height width"]:
        """How far away the nearest thing of the pixels around each is; infinity where they show nothing."""
        there = torch.where(self.opacity > CLEAR, self.depth, torch.inf)
        return -max_pool2d(-there[None], AROUND, 1, AROUND // 2)[0]

    def pixels(self, points: Float[Tensor, "point 3"]) -> tuple[Tensor, Tensor, Float[Tensor, " point"]]:
        """The number of the pixel that each point lies in, whether it lies in one, and how far away it is."""
        height, width = self.depth.shape
        xy, valid = self.camera.project(points)
        x, y = xy.nan_to_num(-1.0, -1.0, -1.0).clamp(-1, max(width, height)).floor().long().unbind(-1)
        inside = valid & (x >= 0) & (y >= 0) & (x < width) & (y < height)
        return torch.where(inside, y * width + x, 0), inside, (points - self.camera.position).norm(dim=-1)

    def sees(self, points: Float[Tensor, "point 3"]) -> Bool[Tensor, " point"]:
        """Which points lie in the picture with nothing before them."""
        pixel, inside, away = self.pixels(points)
        return inside & (away < (1 + MARGIN) * self.depth.view(-1)[pixel])

    def sees_past(self, points: Float[Tensor, "point 3"]) -> Bool[Tensor, " point"]:
        """Which points this camera shows to be empty: all that it sees around them lies behind, or there is nothing."""
        pixel, inside, away = self.pixels(points)
        return inside & ((1 + MARGIN) * away < self.nearest.view(-1)[pixel])


@dataclass(frozen=True)
class Surface:
    """Places on surfaces, from where cameras see them.

    normals: unit length, either way
    origins: of the camera that saw each
    """

    points: Float[Tensor, "point 3"]
    normals: Float[Tensor, "point 3"]
    colours: Float[Tensor, "point 3"]
    origins: Float[Tensor, "point 3"]

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: Tensor) -> Surface:
        """The places that a mask or an index tensor picks."""
        return Surface(self.points[index], self.normals[index], self.colours[index], self.origins[index])


@torch.no_grad()
def survey(method: Any, cameras: Camera) -> list[Sight]:
    """What evenly chosen cameras see of a method, in small pictures."""
    chosen = evenly(range(len(cameras)), VIEWS)
    return [sighted(method, cameras[i]) for i in track(chosen, "Looking at what there is", len(chosen))]


def sighted(method: Any, camera: Camera) -> Sight:
    """What one camera sees, no larger than LONGEST pixels."""
    camera = camera.to("cpu")
    camera = camera.resized(min(1.0, LONGEST / int(camera.size.max())))
    seen = method.render(camera).cpu()
    behind = (1 - seen.opacity[..., None]) * torch.tensor(method.frame.background)
    rgb = ((seen.rgb - behind) / seen.opacity[..., None].clamp_min(CLEAR)).clamp(0, 1)
    return Sight(camera, rgb, seen.depth, seen.opacity)


def empty(points: Float[Tensor, "point 3"], sights: Sequence[Sight]) -> Bool[Tensor, " point"]:
    """Which points several cameras see past, so that nothing is there, whatever a field says of them."""
    needed = min(WITNESSES, len(sights))
    left, count = torch.arange(len(points)), torch.zeros(len(points), dtype=torch.int64)
    for sight in sights:
        count[left] += sight.sees_past(points[left])
        left = left[count[left] < needed]
    return count >= needed


def surface(sights: Sequence[Sight]) -> Surface:
    """All places on surfaces that pixels show, but those that other cameras see past; maybe none."""
    parts = []
    for sight in sights:
        rays, solid = sight.camera.rays(sight.camera.pixels()), sight.solid.flatten()
        depth = sight.depth.flatten().nan_to_num(posinf=1e6)
        points = rays.at(depth)
        normals = normals_from_depth(points.view(*sight.depth.shape, 3), depth.view(sight.depth.shape)).view(-1, 3)
        found = Surface(points, normals, sight.rgb.view(-1, 3), rays.origins)
        parts.append(found[solid & normals.isfinite().all(-1)])
    names = ("points", "normals", "colours", "origins")
    every = Surface(*(torch.cat([getattr(part, name) for part in parts]) for name in names))
    return every[~empty(every.points, sights)]
