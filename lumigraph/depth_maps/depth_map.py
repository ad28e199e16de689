"""DepthMap: the distance to the first surface at every pixel of one camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from ..camera import Camera
from ..camera.rays import Rendering
from ..datasets.images import cosines
from ..geometry import Vector, normals_from_depth
from . import loops

SURFACE_OPACITY = 0.5  # a pixel above it shows a surface
CLEAR_OPACITY = 0.02  # a pixel up to it shows nothing
FAR_DEPTH = 1e6  # scene units: stands for infinity and NaN where neighbouring pixels are subtracted
FREE_SPACE_WINDOW = 3  # pixels a side, whose nearest surface bounds free space, so that thin things are kept


@dataclass(frozen=True)
class Tolerance:
    """A length in scene units that may grow with the distance d from the camera: constant + per_distance d."""

    constant: float = 0.0
    per_distance: float = 0.0

    def __call__(self, distance: Float[Tensor, " point"]) -> Float[Tensor, " point"]:
        return self.constant + self.per_distance * distance


VISIBLE_TOLERANCE = Tolerance(per_distance=0.02)  # behind a rendered surface, within which a point is visible
DEPTH_EDGE = Tolerance(per_distance=0.1)  # between neighbouring pixels, where one surface ends before another


class Comparison(NamedTuple):
    """Points compared with the surface that one camera sees.

    ahead:    how far the surface lies behind each point along its ray, scene units: negative for hidden points,
              infinity where the ray meets nothing, NaN for points outside the picture or where nobody measured
    smooth:   whether the surface is one there, rather than an edge in front of something else
    pixels:   where the points lie in the picture (x, y)
    distance: from the camera, scene units
    """

    ahead: Float[Tensor, " point"]
    smooth: Bool[Tensor, " point"]
    pixels: Float[Tensor, "point 2"]
    distance: Float[Tensor, " point"]


def back_project(
    camera: Camera, pixels: Float[Tensor, "point 2"], depth: Float[Tensor, " point"], along_axis: bool = False
) -> Float[Tensor, "point 3"]:
    """Points o + t d in the world, of pixels (x, y) of one camera and their depths t in scene units.

    along_axis: depth is measured along the optical axis (z-depth): t = z / cos, with the angle of ray and axis
    """
    rays = camera.rays(pixels)
    return rays.at((depth / cosines(rays.directions, camera.forward)).to(depth) if along_axis else depth)


@dataclass(frozen=True)
class SurfacePoints:
    """Points of surfaces in the frame of the cameras that saw them.

    normals: unit length, towards the camera
    colours: sRGB-encoded, in [0, 1]
    origins: position of the camera that saw each
    """

    points: Float[Tensor, "point 3"]
    normals: Float[Tensor, "point 3"]
    colours: Float[Tensor, "point 3"]
    origins: Float[Tensor, "point 3"]

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: Tensor) -> SurfacePoints:
        """The points that a mask or an index tensor picks."""
        return SurfacePoints(self.points[index], self.normals[index], self.colours[index], self.origins[index])

    @staticmethod
    def cat(parts: Sequence[SurfacePoints]) -> SurfacePoints:
        """One set from several."""
        names = ("points", "normals", "colours", "origins")
        return SurfacePoints(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True)
class DepthMap:
    """One camera and the first surface along each pixel's ray. Rows of pixels, on the CPU.

    camera:  a batch of one, of this size
    depth:   distance along the ray, scene units; infinity where nothing is, NaN where nobody measured
    opacity: share of light that is stopped, in [0, 1]; a pixel shows a surface above SURFACE_OPACITY
    rgb:     sRGB-encoded, in [0, 1], without the background
    normals: of the surface, unit length, where whoever made the map knows them; else they follow from the depth
    """

    camera: Camera
    depth: Float[Tensor, "height width"]
    opacity: Float[Tensor, "height width"]
    rgb: Float[Tensor, "height width 3"]
    normals: Float[Tensor, "height width 3"] | None = None

    @staticmethod
    def of_rendering(camera: Camera, rendering: Rendering, background: Vector) -> DepthMap:
        """Depth map of what a method renders of this camera; the background is taken out of its colours.

        c = (C - (1 - a) b) / a    (Porter & Duff 1984, C = a c + (1 - a) b), with a at least CLEAR_OPACITY
        """
        seen = rendering.cpu()
        opacity = seen.opacity[..., None]
        rgb = (seen.rgb - (1 - opacity) * torch.tensor(background)) / opacity.clamp_min(CLEAR_OPACITY)
        return DepthMap(camera.to("cpu"), seen.depth, seen.opacity, rgb.clamp(0, 1))

    @staticmethod
    def measured(
        camera: Camera, depth: Float[Tensor, "height width"], rgb: Float[Tensor, "height width 3"]
    ) -> DepthMap:
        """Depth map of a sensor, a depth file or a plane sweep. Opacity is 1 where something was measured, else 0.

        depth: along rays, scene units, as a photograph's layer has it (`Photograph.extra["depth"]`); infinity where
               nothing is, NaN where nobody measured
        """
        return DepthMap(camera, depth, depth.isfinite().float(), rgb)

    @cached_property
    def solid(self) -> Bool[Tensor, "height width"]:
        """Pixels that show a surface."""
        return (self.opacity > SURFACE_OPACITY) & self.depth.isfinite()

    @cached_property
    def surface_depth(self) -> Float[Tensor, "height width"]:
        """Depth of pixels that show a surface; infinity for others, NaN where nobody measured."""
        return torch.where(self.solid | self.depth.isnan(), self.depth, torch.inf)

    @property
    def surface_normals(self) -> Float[Tensor, "height width 3"]:
        """Unit normals towards the camera: the given ones, else from differences of depth between pixels."""
        return self._orientation[0]

    @property
    def facing(self) -> Float[Tensor, "height width"]:
        """Cosine between the normal and the way back to the camera; 0 where there is no surface."""
        return self._orientation[1]

    @cached_property
    def _orientation(self) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width"]]:
        rays, normals = self.camera.rays(self.camera.pixels()), self.normals
        if normals is None:
            depth = self.surface_depth.nan_to_num(FAR_DEPTH, FAR_DEPTH)
            normals = normals_from_depth(rays.at(depth.view(-1)).view(*depth.shape, 3), depth)
        facing = -(normals * rays.directions.view(normals.shape)).sum(-1)
        return normals * facing.sign()[..., None], facing.abs() * self.solid

    def positions(self, chosen: Tensor | None = None) -> Float[Tensor, "point 3"]:
        """Points in the world where pixels' rays meet the surface (`back_project`).

        chosen: a mask of pixels or their numbers, row by row; None for those that show a surface
        """
        index = (self.solid if chosen is None else chosen).flatten()
        return back_project(self.camera, self.camera.pixels()[index], self.depth.flatten()[index])

    def points(self, chosen: Tensor | None = None) -> SurfacePoints:
        """Back-projected points with normals and colours; chosen as for `positions`."""
        index = (self.solid if chosen is None else chosen).flatten()
        positions, (normals, rgb) = self.positions(index), (x.view(-1, 3) for x in (self.surface_normals, self.rgb))
        return SurfacePoints(positions, normals[index], rgb[index], self.camera.position.expand(len(positions), 3))

    def project(
        self, points: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, "point 2"], Bool[Tensor, " point"], Float[Tensor, " point"]]:
        """Pixels (x, y) of points in the world, whether the lens sees them, and how far away they are."""
        pixels, valid = self.camera.project(points)
        return pixels, valid, (points - self.camera.position).norm(dim=-1)

    def compare(self, points: Float[Tensor, "point 3"], edge: Tolerance = DEPTH_EDGE) -> Comparison:
        """Points beside the surface that the camera sees, whose depth is interpolated between pixels.

        edge: difference in depth between neighbouring pixels from which on there is an edge. There a point counts as
              seen only if it lies in front of both sides
        """
        pixels, valid, away = self.project(points)
        ahead, smooth = torch.empty_like(away), torch.empty_like(valid)
        given = pixels, valid, away, self.surface_depth
        spans = edge.constant, edge.per_distance
        loops.compare(*(x.numpy() for x in given), *spans, ahead.numpy(), smooth.numpy())
        return Comparison(ahead, smooth, pixels, away)

    def sees(
        self,
        points: Float[Tensor, "point 3"],
        tolerance: Tolerance = VISIBLE_TOLERANCE,
        edge: Tolerance | None = DEPTH_EDGE,
    ) -> Bool[Tensor, " point"]:
        """Mask of visible points: inside the picture, and no farther than the tolerance behind its surface.

        edge: as for `compare`; None takes the depth of the nearest pixel whatever its opacity, for translucent fields
        """
        if edge is None:
            pixels, valid, away = self.project(points)
            depth = self.at_pixels(self.depth, pixels)
            return self.inside(pixels, valid) & (away < depth + tolerance(depth))
        compared = self.compare(points, edge)
        return compared.ahead >= -tolerance(compared.distance)

    def sees_past(
        self, points: Float[Tensor, "point 3"], tolerance: Tolerance = VISIBLE_TOLERANCE
    ) -> Bool[Tensor, " point"]:
        """Mask of points in front of all that the pixels around them show, by more than the tolerance. Pixels that are
        neither clear nor solid count as surfaces here."""
        pixels, valid, away = self.project(points)
        return self.inside(pixels, valid) & (away + tolerance(away) < self.at_pixels(self._nearest, pixels))

    def inside(self, pixels: Float[Tensor, "point 2"], valid: Bool[Tensor, " point"]) -> Bool[Tensor, " point"]:
        """Mask of projected points that lie in the picture."""
        return valid & ((pixels >= 0) & (pixels < self.camera.size)).all(-1)

    def at_pixels(self, values: Float[Tensor, "height width *channels"], pixels: Float[Tensor, "point 2"]) -> Tensor:
        """Values of the pixels that places (x, y) in the picture lie in; those outside take the nearest."""
        height, width = values.shape[:2]
        x, y = pixels.nan_to_num().floor().long().unbind(-1)
        return values[y.clamp(0, height - 1), x.clamp(0, width - 1)]

    @cached_property
    def _nearest(self) -> Float[Tensor, "height width"]:
        """Depth of the nearest of the pixels around each that are not clear; NaN where one of them is NaN."""
        there = torch.where((self.opacity > CLEAR_OPACITY) | self.depth.isnan(), self.depth, torch.inf)
        return -max_pool2d(-there[None], FREE_SPACE_WINDOW, 1, FREE_SPACE_WINDOW // 2)[0]
