"""Dense point cloud from photographs with known cameras: plane sweeps with a consistency check.

Each photograph is swept against some neighbours at many depths (Collins 1996); the depth of least cost is kept if
neighbours, swept themselves, have the same point (Merrell 2007).
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ... import kernels
from ...datasets.scene import Scene
from ...depth_maps.flat_view import FlatView, flat_view
from ...depth_maps.multi_view import around, best_neighbours, choose_neighbours, everywhere
from ...geometry import evenly
from ...system.progress import track

MAX_VIEWS, MIN_VIEWS = 48, 8  # photographs asked at most, and however short the time
MAX_SIDE, COARSE_SIDE = 160, 80  # pixels of their longer side, and where no depth is known yet
NEIGHBOURS, BEST = 4, 2  # of each photograph, and how many of them must see a place
ANCHORS = 200  # places by which two views are asked whether they see the same
MIN_HYPOTHESES, MAX_HYPOTHESES = 16, 80
MAX_COST = 0.4  # at most: a correlation of 0.6
AGREEMENT = 0.02  # of its depth: how far apart two views may find a place
WINDOW = 5  # pixels


@dataclass(frozen=True)
class Points:
    """Points in the scene's frame, their colours in [0, 1], and the size of a pixel there.

    origins: positions of the cameras that found them
    share:   of the swept pixels with a point
    """

    positions: Float[Tensor, "point 3"]
    colours: Float[Tensor, "point 3"]
    sizes: Float[Tensor, " point"]
    origins: Float[Tensor, "point 3"]
    share: float = 1.0


@torch.no_grad()
def seen_points(scene: Scene, seconds: float = math.inf) -> Points:
    """Points visible in at least two or three of the training photographs, about a pixel apart; maybe none.

    seconds: time for sweeping, about; fewer photographs are used where all would take longer
    Depths are searched around the scene's sparse points; without any, around the depths of smaller pictures.
    """
    chosen = evenly(scene.splits["train"].tolist(), MAX_VIEWS)
    views = [flat_view(scene.photograph(i), MAX_SIDE) for i in chosen]
    known = scene.points
    if known is None or len(known) < ANCHORS:
        small = [flat_view(scene.photograph(i), COARSE_SIDE) for i in chosen]
        seconds = seconds / 2
        known = swept(small, [everywhere(view, scene) for view in small], "Looking for depth", seconds).positions
    ranges = [around(view, known) or everywhere(view, scene) for view in views]
    return swept(views, ranges, "Sweeping for points", seconds)


def compile_sweep() -> None:
    """Compile the kernel, on one dark pixel, so that it takes no time in `seen_points`."""
    dark, warp = torch.zeros(1, 1, 1), torch.eye(3, 4)[None]
    kernels.plane_sweep(dark[0], dark[0], dark, dark, warp, torch.ones(1), WINDOW, 1)


def swept(views: Sequence[FlatView], ranges: Sequence[tuple[float, float]], what: str, seconds: float) -> Points:
    """Consistent points of the views; of as many views as the time allows."""
    if seconds < math.inf:
        some = evenly(list(range(len(views))), affordable(views, ranges, seconds))
        views, ranges = [views[i] for i in some], [ranges[i] for i in some]
    neighbours = choose_neighbours(views, ranges, NEIGHBOURS)
    depths = []
    for i in track(range(len(views)), what, len(views)):
        depths.append(sweep(views[i], [views[j] for j in neighbours[i]], ranges[i]))
    positions, colours, sizes = [torch.zeros(0, 3)], [torch.zeros(0, 3)], [torch.zeros(0)]
    origins = [torch.zeros(0, 3)]
    for i, view in enumerate(views):
        found = depths[i] > 0
        places = view.pose[:, 3] + view.rays[found] * depths[i][found][:, None]
        agree = torch.zeros(len(places), dtype=torch.int)
        for j in neighbours[i]:
            seen, row, column, depth = views[j].sees(places)
            agree += seen & ((depths[j][row, column] / depth - 1).abs() < AGREEMENT)
        kept = agree >= (2 if len(neighbours[i]) > 2 else 1)
        positions.append(places[kept])
        colours.append(view.rgb[found][kept])
        sizes.append(depths[i][found][kept] / view.intrinsics[0, 0])
        origins.append(view.pose[:, 3].expand(int(kept.sum()), 3))
    share = sum(len(x) for x in positions) / max(sum(view.trust.numel() for view in views), 1)
    return Points(torch.cat(positions), torch.cat(colours), torch.cat(sizes), torch.cat(origins), share)


def affordable(views: Sequence[FlatView], ranges: Sequence[tuple[float, float]], seconds: float) -> int:
    """Number of views that can be swept in a time, measured by one."""
    begin, middle = time.perf_counter(), len(views) // 2
    positions = torch.stack([view.pose[:, 3] for view in views])
    sweep(
        views[middle],
        [views[j] for j in best_neighbours(middle, views, positions, ranges[middle], NEIGHBOURS)],
        ranges[middle],
    )
    return max(int(seconds / (time.perf_counter() - begin)), MIN_VIEWS)


def sweep(view: FlatView, neighbours: Sequence[FlatView], span: tuple[float, float]) -> Float[Tensor, "height width"]:
    """Depth along the axis of each pixel, 0 for unreliable ones."""
    if not neighbours:
        return torch.zeros_like(view.trust)
    warps = torch.stack([view.warp_to(other) for other in neighbours])
    near, far = 1 / span[0], 1 / span[1]
    count = min(max(math.ceil(disparity(view, warps, near, far)) + 1, MIN_HYPOTHESES), MAX_HYPOTHESES)
    hypotheses = torch.linspace(far, near, count)
    pictures, trust = (padded([getattr(x, name) for x in neighbours]) for name in ("grey", "trust"))
    best = min(BEST, len(neighbours))
    cost = kernels.plane_sweep(view.grey, view.trust, pictures, trust, warps, hypotheses, WINDOW, best)
    least, plane = cost.min(0)
    # The lowest place of the parabola through the least cost and the costs beside it.
    beside = [cost.gather(0, (plane + k).clamp(0, count - 1)[None])[0] for k in (-1, 1)]
    bend = (beside[0] + beside[1] - 2 * least).clamp_min(1e-6)
    inverse = far + (plane + 0.5 * (beside[0] - beside[1]) / bend) * ((near - far) / (count - 1))
    sure = (least < MAX_COST) & (plane > 0) & (plane < count - 1) & (view.trust > 0.99)
    return torch.where(sure, 1 / inverse, 0)


def disparity(view: FlatView, warps: Float[Tensor, "neighbour 3 4"], near: float, far: float) -> float:
    """Disparity range of a view's centre in its neighbours, in pixels, clamped to their width."""
    height, width = view.trust.shape
    middle = torch.tensor([width / 2, height / 2, 1.0])
    places = [warps[:, :, :3] @ middle + h * warps[:, :, 3] for h in torch.linspace(far, near, 64).tolist()]
    seen = torch.stack([p[:, :2] / p[:, 2:].clamp_min(1e-6) for p in places])
    steps = seen.diff(dim=0).norm(dim=-1)
    inside = (seen - middle[:2]).abs().amax(-1) < max(height, width)
    return float((steps * inside[1:]).sum(0).max())


def padded(pictures: Sequence[Float[Tensor, "_ _"]]) -> Float[Tensor, "picture height width"]:
    """Pictures of any sizes stacked in one tensor, padded with zeros."""
    size = torch.tensor([p.shape for p in pictures]).amax(0).tolist()
    out = torch.zeros(len(pictures), *size)
    for one, picture in zip(out, pictures, strict=True):
        one[: picture.shape[0], : picture.shape[1]] = picture
    return out


def thinned(points: Points, spacing: float = 1.0) -> Points:
    """Means of points in grid cells of about `spacing` pixels' size there, to within a half."""
    level = (points.sizes * spacing).log2().round().int()
    cell = (points.positions / torch.exp2(level)[:, None]).floor().long()
    key = torch.cat([level[:, None].long(), cell], 1)
    _, place, count = key.unique(dim=0, return_inverse=True, return_counts=True)

    def mean(values: Tensor) -> Tensor:
        total = values.new_zeros(len(count), *values.shape[1:]).index_add_(0, place, values)
        return total / count.view(-1, *[1] * (values.ndim - 1))

    return Points(mean(points.positions), mean(points.colours), mean(points.sizes), mean(points.origins), points.share)
