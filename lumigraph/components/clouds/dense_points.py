"""A dense cloud of points from photographs with known cameras, by multi-view stereo (`depth_maps.multi_view`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ...datasets.scene import Scene
from ...depth_maps import DepthMap, SurfacePoints
from ...depth_maps.multi_view import multi_view_depth

MAX_SIDE = 200  # pixels along the longer side of a depth map


@dataclass(frozen=True)
class Points:
    """Points of surfaces in the scene's frame.

    normals: unit length, towards the camera
    colours: in [0, 1]
    sizes:   of a pixel there
    origins: positions of the cameras that found them
    share:   of the pixels at which a point was found
    """

    positions: Float[Tensor, "point 3"]
    colours: Float[Tensor, "point 3"]
    sizes: Float[Tensor, " point"]
    origins: Float[Tensor, "point 3"]
    normals: Float[Tensor, "point 3"]
    share: float = 1.0


def seen_points(scene: Scene, seconds: float = math.inf) -> Points:
    """Points at pixels of training photographs whose depth neighbours confirm; maybe none.

    seconds: that matching may take, about
    """
    return points_of(multi_view_depth(scene, MAX_SIDE, seconds))


def points_of(maps: list[DepthMap]) -> Points:
    """Points of all sure pixels of depth maps."""
    found = SurfacePoints.cat([seen.points() for seen in maps])
    sizes = [
        seen.depth[seen.solid] / float(seen.camera.lens.focal[0, 0])  # type: ignore[attr-defined]
        for seen in maps
    ]
    share = len(found) / max(sum(seen.depth.numel() for seen in maps), 1)
    return Points(found.points, found.colours, torch.cat(sizes), found.origins, found.normals, share)


def thinned(points: Points, spacing: float = 1.0) -> Points:
    """Means of points that lie in one cell; cells are as large as `spacing` pixels there, to within a half."""
    level = (points.sizes * spacing).log2().round().int()
    cell = (points.positions / torch.exp2(level)[:, None]).floor().long()
    key = torch.cat([level[:, None].long(), cell], 1)
    _, place, count = key.unique(dim=0, return_inverse=True, return_counts=True)

    def mean(values: Tensor) -> Tensor:
        total = values.new_zeros(len(count), *values.shape[1:]).index_add_(0, place, values)
        return total / count.view(-1, *[1] * (values.ndim - 1))

    names = ("positions", "colours", "sizes", "origins", "normals")
    return Points(**{name: mean(getattr(points, name)) for name in names}, share=points.share)
