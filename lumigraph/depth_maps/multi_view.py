"""Several depth maps of one scene: how they are rendered, and what they show together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..camera import Camera
from ..camera.rays import Rendering
from ..errors import LumigraphError
from ..geometry import Vector, evenly
from ..system.progress import track
from .depth_map import DepthMap, SurfacePoints, Tolerance

MIN_FREE_VIEWS = 2  # cameras that must see past a point for it to lie in free space
CAMERAS_PER_VIEW = 16  # one camera in so many must see a point, and at least one: single depths err at edges


@torch.no_grad()
def render_depth_maps(
    render: Callable[[Camera], Rendering], cameras: Camera, background: Vector, views: int = 64, size: int = 400
) -> list[DepthMap]:
    """Depth maps of evenly chosen cameras. Raises LumigraphError where none of them shows a surface.

    render:     what one camera sees, such as `Method.render`
    background: sRGB-encoded colour behind the renderings
    views:      cameras at most
    size:       longer side of the maps at most, pixels
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
    """Points of all pixels that show a surface, less those that other cameras see past; maybe none."""
    every = SurfacePoints.cat([seen.points() for seen in depth_maps])
    return every[~free(every.points, depth_maps)]


def free(points: Float[Tensor, "point 3"], depth_maps: Sequence[DepthMap]) -> Bool[Tensor, " point"]:
    """Mask of points in free space: at least two cameras (or the only one) see past them."""
    needed = min(MIN_FREE_VIEWS, len(depth_maps))
    return _confirmed(points, depth_maps, needed, lambda seen, some: seen.sees_past(some))


def hidden(
    points: Float[Tensor, "point 3"], depth_maps: Sequence[DepthMap], tolerance: Tolerance
) -> Bool[Tensor, " point"]:
    """Mask of points that are hidden from all cameras but a few, or lie outside all pictures.

    tolerance: how far behind a surface a point still counts as seen
    """
    needed = 1 + len(depth_maps) // CAMERAS_PER_VIEW
    tracked = track(depth_maps, "Looking for what no camera sees", len(depth_maps))
    return ~_confirmed(points, tracked, needed, lambda seen, some: seen.sees(some, tolerance, tolerance))


def _confirmed(
    points: Float[Tensor, "point 3"],
    depth_maps: Iterable[DepthMap],
    needed: int,
    test: Callable[[DepthMap, Tensor], Tensor],
) -> Bool[Tensor, " point"]:
    """Mask of points that pass a test in so many maps; each is tested no further than that."""
    left, count = torch.arange(len(points)), torch.zeros(len(points), dtype=torch.int64)
    for depth_map in depth_maps:
        count[left] += test(depth_map, points[left])
        left = left[count[left] < needed]
    return count >= needed
