"""DepthMap: distance to the first surface at every pixel of a camera; of several: free space, TSDF, colours."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d

from ..camera import Camera
from ..camera.rays import Rendering
from ..datasets.images import cosines
from ..errors import LumigraphError
from ..geometry import Vector, evenly, normals_from_depth, unit
from ..system.progress import track
from ..system.threads import processors
from . import loops

SURFACE_OPACITY = 0.5  # a pixel above it shows a surface
CLEAR_OPACITY = 0.02  # a pixel up to it shows nothing
FAR_DEPTH = 1e6  # scene units: stands for infinity and NaN where neighbouring pixels are subtracted
FREE_SPACE_WINDOW = 3  # pixels a side, whose nearest surface bounds free space, so that thin things are kept
POINTS_PER_TASK = 10_000  # PyTorch shares out no operation on so few, and they stay in the nearest cache
MIN_FACING = 0.3  # cosine that weights a pixel at least: one without a surface shows that nothing is there
MIN_COSINE = 0.05  # between a surface's normal and the way to a camera whose colour counts
MIN_FREE_VIEWS = 2  # cameras that must see past a point for it to lie in free space
MIN_AGREEING_VIEWS = 2  # cameras that must see a surface at the same place
CAMERAS_PER_VIEW = 16  # one camera in so many must see a point, and at least one: single depths err at edges


@dataclass(frozen=True)
class Tolerance:
    """A length in scene units that may grow with the distance d from the camera: constant + per_distance d."""

    constant: float = 0.0
    per_distance: float = 0.0

    def __call__(self, distance: Float[Tensor, " point"]) -> Float[Tensor, " point"]:
        return self.constant + self.per_distance * distance


VISIBLE_TOLERANCE = Tolerance(per_distance=0.02)  # behind a rendered surface, within which a point is visible
DEPTH_EDGE = Tolerance(per_distance=0.1)  # between neighbouring pixels, where one surface ends before another


class SurfaceComparison(NamedTuple):
    """Points compared with one camera's depth map.

    ahead:    distance of the surface behind each point along its ray, scene units: negative for hidden points, infinity
              for empty rays, NaN for points outside the picture or unmeasured
    smooth:   False at a depth edge
    pixels:   (x, y) of the points
    distance: from the camera, scene units
    """

    ahead: Float[Tensor, " point"]
    smooth: Bool[Tensor, " point"]
    pixels: Float[Tensor, "point 2"]
    distance: Float[Tensor, " point"]


def back_project(
    camera: Camera, pixels: Float[Tensor, "point 2"], depth: Float[Tensor, " point"], along_axis: bool = False
) -> Float[Tensor, "point 3"]:
    """Back-project pixels (x, y) of one camera with depths t in scene units: o + t d.

    along_axis: depth is measured along the optical axis (z-depth): t = z / cos, with the angle of ray and axis
    """
    rays = camera.rays(pixels)
    return rays.at((depth / cosines(rays.directions, camera.forward)).to(depth) if along_axis else depth)


@dataclass(frozen=True)
class SurfacePoints:
    """Surface points in the frame of the cameras.

    normals: unit length, towards the camera
    colours: sRGB-encoded, in [0, 1]
    origins: position of each point's camera
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
        names = ("points", "normals", "colours", "origins")
        return SurfacePoints(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True)
class DepthMap:
    """One camera and the first surface along each pixel's ray. Rows of pixels, on the CPU.

    camera:  a batch of one, of this size
    depth:   distance along the ray, scene units; infinity for empty space, NaN for unmeasured
    opacity: accumulated opacity, in [0, 1]; a pixel shows a surface above SURFACE_OPACITY
    rgb:     sRGB-encoded, in [0, 1], without the background
    normals: of the surface, unit length, where known; else they follow from the depth
    """

    camera: Camera
    depth: Float[Tensor, "height width"]
    opacity: Float[Tensor, "height width"]
    rgb: Float[Tensor, "height width 3"]
    normals: Float[Tensor, "height width 3"] | None = None

    @staticmethod
    def of_rendering(camera: Camera, rendering: Rendering, background: Vector) -> DepthMap:
        """Depth map of a method's rendering for this camera; the background is removed from its colours.

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
        """Depth map of a sensor, a depth file or multi-view stereo. Opacity is 1 for measured pixels, else 0.

        depth: along rays, scene units, as in a photograph's layer (`Photograph.extra["depth"]`); infinity for empty
               space, NaN for unmeasured
        """
        return DepthMap(camera, depth, depth.isfinite().float(), rgb)

    def within(self, mask: Bool[Tensor, "rows columns"]) -> DepthMap:
        """Depth within a mask of the picture, of any size; NaN elsewhere."""
        sized = interpolate(mask[None, None].float(), tuple(self.depth.shape), mode="nearest-exact")[0, 0] > 0
        return replace(self, depth=torch.where(sized, self.depth, torch.nan))

    @cached_property
    def solid(self) -> Bool[Tensor, "height width"]:
        """Pixels that show a surface."""
        return (self.opacity > SURFACE_OPACITY) & self.depth.isfinite()

    @cached_property
    def surface_depth(self) -> Float[Tensor, "height width"]:
        """Depth of pixels that show a surface; infinity for others, NaN for unmeasured."""
        return torch.where(self.solid | self.depth.isnan(), self.depth, torch.inf)

    @property
    def surface_normals(self) -> Float[Tensor, "height width 3"]:
        """Unit normals towards the camera: the given ones, else from differences of depth between pixels."""
        return self._orientation[0]

    @property
    def facing(self) -> Float[Tensor, "height width"]:
        """Cosine between the normal and the direction to the camera; 0 without a surface."""
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
        """World positions of pixels' surface points (`back_project`).

        chosen: a mask of pixels or their row-major indices; None for those that show a surface
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
        """Pixels (x, y) of points in the world, a mask of valid projections, and their distances."""
        pixels, valid = self.camera.project(points)
        return pixels, valid, (points - self.camera.position).norm(dim=-1)

    def compare(self, points: Float[Tensor, "point 3"], edge: Tolerance = DEPTH_EDGE) -> SurfaceComparison:
        """Compare points with the camera's surface, whose depth is interpolated between pixels.

        edge: difference in depth between neighbouring pixels that counts as a depth edge. There a point counts as
              visible only if it lies in front of both sides
        """
        pixels, valid, away = self.project(points)
        ahead, smooth = torch.empty_like(away), torch.empty_like(valid)
        given = pixels, valid, away, self.surface_depth
        spans = edge.constant, edge.per_distance
        loops.compare(*(x.numpy() for x in given), *spans, ahead.numpy(), smooth.numpy())
        return SurfaceComparison(ahead, smooth, pixels, away)

    def sees(
        self,
        points: Float[Tensor, "point 3"],
        tolerance: Tolerance = VISIBLE_TOLERANCE,
        edge: Tolerance | None = DEPTH_EDGE,
    ) -> Bool[Tensor, " point"]:
        """Mask of visible points: inside the picture, and at most the tolerance behind its surface.

        edge: as for `compare`; None takes the depth of the nearest pixel of any opacity, for translucent fields
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
        """Mask of points in free space: in front of all surfaces of the pixels around, by more than the tolerance.
        Translucent pixels count as surfaces here."""
        pixels, valid, away = self.project(points)
        return self.inside(pixels, valid) & (away + tolerance(away) < self.at_pixels(self._nearest, pixels))

    def inside(self, pixels: Float[Tensor, "point 2"], valid: Bool[Tensor, " point"]) -> Bool[Tensor, " point"]:
        """Mask of projected points inside the picture."""
        return valid & ((pixels >= 0) & (pixels < self.camera.size)).all(-1)

    def at_pixels(self, values: Float[Tensor, "height width *channels"], pixels: Float[Tensor, "point 2"]) -> Tensor:
        """Values of the pixels at coordinates (x, y), clamped to the picture."""
        height, width = values.shape[:2]
        x, y = pixels.nan_to_num().floor().long().unbind(-1)
        return values[y.clamp(0, height - 1), x.clamp(0, width - 1)]

    @cached_property
    def _nearest(self) -> Float[Tensor, "height width"]:
        """Least depth of the non-transparent pixels around each; NaN if one of them is NaN."""
        there = torch.where((self.opacity > CLEAR_OPACITY) | self.depth.isnan(), self.depth, torch.inf)
        return -max_pool2d(-there[None], FREE_SPACE_WINDOW, 1, FREE_SPACE_WINDOW // 2)[0]


class SignedDistance(NamedTuple):
    """Fused distances at points.

    distance:   over the truncation, in [-1, 1]: positive in front of the surface, NaN if unknown to all cameras
    truncation: weighted mean of the cameras', scene units; NaN if unknown to all cameras
    pictured:   whether any map has a measurement along the ray through the point, hidden or not
    """

    distance: Float[Tensor, " point"]
    truncation: Float[Tensor, " point"]
    pictured: Bool[Tensor, " point"]


@dataclass(frozen=True)
class TSDF:
    """Truncated signed distance D, a function of points (Curless and Levoy 1996, eq. 1 and 2).

        D(x) = sum w d / sum w,    d = min((depth - |x - o|) / t, 1),    w = cos / |x - o|^2

    over cameras at o, each with its depth in the direction of x and the truncation t. Its weight is the cosine of its
    viewing angle on the surface over the area of its pixel there (section 4). A camera with d < -1 is left out: points
    deeper behind its surface are unknown to it. Distances are along rays, in scene units.
    edge: difference in depth between neighbouring pixels that counts as a depth edge; None for the truncation
    """

    depth_maps: Sequence[DepthMap]
    truncation: Tolerance
    edge: Tolerance | None = None

    def __call__(self, points: Float[Tensor, "point 3"]) -> SignedDistance:
        # Each thread takes whole pieces: beside other programs dozens of shared operations for each camera would wait,
        # every time, for the thread that was held up.
        with ThreadPoolExecutor(processors()) as pool:
            found = list(pool.map(self._fused, points.split(POINTS_PER_TASK)))
        return SignedDistance(*(torch.cat(column) for column in zip(*found, strict=True)))

    @torch.no_grad()  # which holds for one thread
    def _fused(self, points: Float[Tensor, "point 3"]) -> SignedDistance:
        total, weight, truncation = (torch.zeros(len(points)) for _ in range(3))
        pictured = torch.zeros(len(points), dtype=torch.bool)
        edge = self.edge or self.truncation
        spans = (edge.constant, edge.per_distance), (self.truncation.constant, self.truncation.per_distance)
        for seen in self.depth_maps:
            given = *seen.project(points), seen.surface_depth, seen.facing
            sums = total, weight, truncation, pictured
            loops.fuse(*(x.numpy() for x in given), MIN_FACING, *spans, *(x.numpy() for x in sums))
        return SignedDistance(total / weight, truncation / weight, pictured)  # 0 / 0 is NaN


def fused_colours(
    points: Float[Tensor, "point 3"],
    normals: Float[Tensor, "point 3"],
    depth_maps: Sequence[DepthMap],
    tolerance: Tolerance,
) -> Float[Tensor, "point 3"]:
    """Colours of surface points, sRGB-encoded: the mean over cameras that see them.

    A camera is weighted by its squared viewing cosine over the area of its pixel there. A point that no camera sees
    takes the colour of the nearest visible one.
    tolerance: largest distance of a visible point from a camera's own surface
    """
    total, weight = torch.zeros(len(points), 3), torch.zeros(len(points))
    for depth_map in track(depth_maps, "Colouring", len(depth_maps)):
        seen = depth_map.compare(points, tolerance)
        cosine = (normals * unit(depth_map.camera.position - points)).sum(-1)
        good = seen.smooth & (seen.ahead.abs() < tolerance(seen.distance)) & (cosine > MIN_COSINE)
        share = torch.where(good, (cosine / seen.distance).square(), 0.0)
        total += share[:, None] * depth_map.at_pixels(depth_map.rgb, seen.pixels)
        weight += share
    known = weight > 0
    if not known.any():
        return torch.full_like(total, 0.5)
    found = total / weight.clamp_min(1e-12)[:, None]
    if not known.all():
        nearest = cKDTree(points[known].numpy()).query(points[~known].numpy())[1]
        found[~known] = found[known][torch.from_numpy(nearest)]
    return found


@torch.no_grad()
def render_depth_maps(
    render: Callable[[Camera], Rendering], cameras: Camera, background: Vector, views: int = 64, size: int = 400
) -> list[DepthMap]:
    """Depth maps of evenly chosen cameras. Raises LumigraphError if none of them shows a surface.

    render:     renders one camera, such as `Method.render`
    background: sRGB-encoded background colour of the renderings
    views:      largest number of cameras
    size:       largest longer side of the maps, pixels
    """
    chosen = evenly(range(len(cameras)), views)
    maps = []
    for i in track(chosen, "Rendering depth maps", len(chosen)):
        camera = cameras[i].to("cpu")
        camera = camera.resized(min(1.0, size / int(camera.size.max())))
        maps.append(DepthMap.of_rendering(camera, render(camera), background))
    if not any(seen.solid.any() for seen in maps):
        raise LumigraphError("No camera sees anything solid, so there is no surface; train for longer and try again")
    return maps


def surface_points(depth_maps: Sequence[DepthMap]) -> SurfacePoints:
    """Points of all pixels that show a surface, without those in other cameras' free space; maybe none."""
    every = SurfacePoints.cat([seen.points() for seen in depth_maps])
    return every[~free(every.points, depth_maps)]


def free(points: Float[Tensor, "point 3"], depth_maps: Sequence[DepthMap]) -> Bool[Tensor, " point"]:
    """Mask of points in free space of at least two cameras (or the only one)."""
    needed = min(MIN_FREE_VIEWS, len(depth_maps))
    return _confirmed(points, depth_maps, needed, lambda seen, some: seen.sees_past(some))


def hidden(
    points: Float[Tensor, "point 3"], depth_maps: Sequence[DepthMap], tolerance: Tolerance
) -> Bool[Tensor, " point"]:
    """Mask of points that are hidden from all but a few cameras, or outside all pictures.

    tolerance: largest distance behind a surface of a visible point
    """
    needed = 1 + len(depth_maps) // CAMERAS_PER_VIEW
    tracked = track(depth_maps, "Looking for what no camera sees", len(depth_maps))
    return ~_confirmed(points, tracked, needed, lambda seen, some: seen.sees(some, tolerance, tolerance))


def measurements(
    points: Float[Tensor, "point 3"], depth_maps: Iterable[DepthMap]
) -> tuple[Int[Tensor, " point"], Int[Tensor, " point"]]:
    """Number of cameras with a measurement in a point's direction, hidden or not, and of those with NaN there."""
    measured, left_out = (torch.zeros(len(points), dtype=torch.int64) for _ in range(2))
    for seen in depth_maps:
        pixels, valid, _ = seen.project(points)
        inside, known = seen.inside(pixels, valid), ~seen.at_pixels(seen.depth, pixels).isnan()
        measured += inside & known
        left_out += inside & ~known
    return measured, left_out


def agreed(
    points: Float[Tensor, "point 3"], depth_maps: Sequence[DepthMap], tolerance: Tolerance
) -> Bool[Tensor, " point"]:
    """Mask of points on which two cameras' surfaces agree, or the only one's.

    tolerance: largest distance along the ray from a camera's own surface
    """

    def agrees(seen: DepthMap, some: Float[Tensor, "point 3"]) -> Bool[Tensor, " point"]:
        compared = seen.compare(some, tolerance)
        return compared.smooth & (compared.ahead.abs() < tolerance(compared.distance))

    needed = min(MIN_AGREEING_VIEWS, len(depth_maps))
    return _confirmed(points, track(depth_maps, "Looking where cameras agree", len(depth_maps)), needed, agrees)


def _confirmed(
    points: Float[Tensor, "point 3"],
    depth_maps: Iterable[DepthMap],
    needed: int,
    test: Callable[[DepthMap, Tensor], Tensor],
) -> Bool[Tensor, " point"]:
    """Mask of points that pass a test in `needed` maps; each is tested no further than that."""
    left, count = torch.arange(len(points)), torch.zeros(len(points), dtype=torch.int64)
    for depth_map in depth_maps:
        count[left] += test(depth_map, points[left])
        left = left[count[left] < needed]
    return count >= needed
