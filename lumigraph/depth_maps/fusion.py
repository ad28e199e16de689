"""Fusion of depth maps: a truncated signed distance (Curless and Levoy 1996), and the colours of its surface."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from ..geometry import unit
from ..system.progress import track
from ..system.threads import processors
from . import loops
from .depth_map import DepthMap, Tolerance

POINTS_PER_TASK = 10_000  # PyTorch shares out no operation on so few, and they stay in the nearest cache
MIN_FACING = 0.3  # cosine that weights a pixel at least: one without a surface shows that nothing is there
MIN_COSINE = 0.05  # between a surface's normal and the way to a camera whose colour counts


class SignedDistance(NamedTuple):
    """Fused distances at points.

    distance:   over the truncation, in [-1, 1]: positive in front of the surface, NaN where no camera knows
    truncation: weighted mean of the cameras', scene units; NaN where no camera knows
    pictured:   whether any map measured along the ray through the point, be it hidden or not
    """

    distance: Float[Tensor, " point"]
    truncation: Float[Tensor, " point"]
    pictured: Bool[Tensor, " point"]


@dataclass(frozen=True)
class TSDF:
    """Truncated signed distance D, a function of points (Curless and Levoy 1996, eq. 1 and 2).

        D(x) = sum w d / sum w,    d = min((depth - |x - o|) / t, 1),    w = cos / |x - o|^2

    over cameras at o, each with the depth that it sees in the direction of x and the truncation t. Its weight is the
    cosine at which it sees the surface over the area of its pixel there (section 4). A camera with d < -1 is left out:
    what lies deeper behind its surface is unknown to it. Distances are along rays, in scene units.
    edge: difference in depth between neighbouring pixels from which on they show two surfaces; None for the truncation
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
    """Colours of points of a surface, sRGB-encoded: the mean over cameras that see them.

    A camera counts with the square of the cosine at which it looks, over the area that its pixel covers there. A point
    that no camera sees takes the colour of the nearest one that some camera does.
    tolerance: how far from a camera's own surface a point may lie to be seen by it
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
