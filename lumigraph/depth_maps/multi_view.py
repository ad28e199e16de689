"""Multi-view stereo: a depth map of each photograph, by coarse-to-fine PatchMatch, with a consistency check."""

import math
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from ..camera import Camera
from ..camera.lens import Pinhole
from ..datasets.scene import Scene
from ..errors import LumigraphWarning
from ..geometry import evenly
from ..system.progress import track
from .depth_map import DepthMap
from .flat_view import FlatView, flat_view
from .patch_match import FAR_AREAS, HYPOTHESES, NEAR_AREAS, PatchMatch, PlaneMap
from .stereo import Disparity, RectifiedPair, rectify

MAX_VIEWS, MIN_VIEWS = 48, 8  # photographs at most, and at least however short the time
MIN_SIDE = 40  # pixels along the longer side at the coarsest level
NEIGHBOURS = 6  # of each photograph
MEETING_ANGLE, NARROWER, WIDER = (math.radians(x) for x in (8.0, 4.0, 8.0))  # of rays; deviations around it
MIN_OVERLAP = 0.02  # share of what a photograph sees, weighted by angle, that a neighbour must see
MIN_POINTS, MIN_KNOWN_POINTS = 16, 200  # in front of a view, and in a scene, that give a range of depths
NEARER, FARTHER = 0.7, 2.0  # times the depths of known points: the range that is searched
DEPTH_TOLERANCE, PIXEL_TOLERANCE = 0.01, 1.0  # of depth and of reprojection, up to which two views agree
MIN_AGREEING = 2  # neighbours that must agree, or the only one
MAX_SURE_COST = 0.9  # of a plane that is sure, whatever neighbours find


@dataclass(frozen=True)
class MatchingLevel:
    """One pyramid level of matching: rounds of iterations, the later ones with geometric consistency.

    reduction: from the finest size
    first:     whether it begins with random planes; else with those of the previous level, with only local changes
    """

    reduction: int
    photometric: int
    geometric: int
    first: bool = False

    @property
    def work(self) -> float:
        """Number of plane evaluations per pixel of the finest size."""
        planes = len(NEAR_AREAS) + 3 + self.first * (len(FAR_AREAS) + 2)
        return (HYPOTHESES * self.first + (self.photometric + self.geometric) * planes) / self.reduction**2


LEVELS = MatchingLevel(4, 3, 2, first=True), MatchingLevel(2, 0, 2), MatchingLevel(1, 0, 2)


@torch.no_grad()
def multi_view_depth(
    scene: Scene, size: int = 400, seconds: float = math.inf, views: int = MAX_VIEWS
) -> list[DepthMap]:
    """Depth maps of training photographs, through ideal pinholes; NaN where neighbours do not agree.

    size:    pixels along the longer side of the maps, about
    seconds: time for matching, about; if it would take longer, maps are smaller and of fewer photographs, and it warns
    views:   largest number of photographs, spread evenly
    Depths are searched around the scene's sparse points, or without any around those of the coarsest level. The
    cameras' `image_index` is the photograph's number.
    """
    begin = time.perf_counter()
    chosen = evenly(scene.splits["train"].tolist(), views)
    sides = [max(size // level.reduction, MIN_SIDE) for level in LEVELS]
    pyramids = [[flat_view(photograph, side) for side in sides] for photograph in map(scene.photograph, chosen)]
    known, coarse = scene.points, [pyramid[0] for pyramid in pyramids]
    if known is None or len(known) < MIN_KNOWN_POINTS:
        anywhere = [everywhere(view, scene) for view in coarse]
        found = match(chosen, [[view] for view in coarse], anywhere, "Looking for depth", seconds / 2)
        known = torch.cat([seen.positions() for seen in found])
    spans = [around(view, known) or everywhere(view, scene) for view in coarse]
    return match(chosen, pyramids, spans, "Matching photographs", seconds - (time.perf_counter() - begin))


@torch.no_grad()
def pair_depth(scene: Scene, first: int, second: int, size: int) -> tuple[RectifiedPair, Disparity]:
    """Rectified pictures of two photographs, and the disparity of the left one. size: of their longer side, about"""
    one, other = (flat_view(scene.photograph(number), size) for number in (first, second))
    known = torch.empty(0, 3) if scene.points is None else scene.points
    spans = [around(view, known) or everywhere(view, scene) for view in (one, other)]
    span = min(near for near, _ in spans), max(far for _, far in spans)
    pair = rectify(one, other, span, f"{scene.names[first]} and {scene.names[second]}")
    return pair, pair.match()


def everywhere(view: FlatView, scene: Scene) -> tuple[float, float]:
    """Depth range of the whole scene in a view."""
    away, radius = float(view.pose[:, 3].norm()), math.sqrt(3) * scene.frame.reach
    return max(scene.frame.near, away - radius), away + radius


def around(view: FlatView, known: Float[Tensor, "point 3"]) -> tuple[float, float] | None:
    """Depth range of the known points in a view, with a margin; None for too few."""
    seen, _, _, depth = view.sees(known)
    if int(seen.sum()) < MIN_POINTS:
        return None
    near, far = depth[seen].quantile(torch.tensor([0.01, 0.99])).tolist()
    return NEARER * near, FARTHER * far


def match(
    photographs: Sequence[int],
    pyramids: Sequence[Sequence[FlatView]],
    spans: Sequence[tuple[float, float]],
    what: str,
    seconds: float,
) -> list[DepthMap]:
    """Coarse-to-fine depth maps of views; of as many views and levels as the time allows.

    photographs: number of each view's photograph; pyramids: its picture at each of the first levels; spans: of its
                 depths
    """
    chance, begin, taken, count = torch.Generator().manual_seed(0), time.perf_counter(), 0.0, len(pyramids)
    if seconds < math.inf:
        some = evenly(list(range(len(pyramids))), affordable([one[0] for one in pyramids], spans, seconds))
        photographs, pyramids = [photographs[i] for i in some], [pyramids[i] for i in some]
        spans = [spans[i] for i in some]
    neighbours = choose_neighbours([one[0] for one in pyramids], spans)
    maps: list[PlaneMap] = []
    for number, level in enumerate(LEVELS[: len(pyramids[0])]):
        spent = time.perf_counter() - begin
        if not level.first and spent + level.work / LEVELS[number - 1].work * taken > seconds:
            break
        views = [one[number] for one in pyramids]
        if maps and views[0].trust.shape == maps[0].view.trust.shape:
            continue
        maps = [maps[i].enlarged(view) if maps else PlaneMap(view, spans[i]) for i, view in enumerate(views)]
        rounds = [(False, level.photometric), (True, level.geometric)]
        for geometric, iterations in rounds:
            for i in track(range(len(maps)), f"{what}, {views[0].trust.shape[1]} pixels", len(maps)):
                if neighbours[i] and iterations:
                    improve(maps, i, neighbours[i], level, geometric, iterations, chance)
        taken = time.perf_counter() - begin - spent
    reached, full = (max(view.trust.shape) for view in (maps[0].view, pyramids[0][-1]))
    if reached < full or len(maps) < count and len(pyramids[0]) > 1:
        warnings.warn(
            f"Stereo had time for depth maps of {reached} of {full} pixels, of {len(maps)} of {count} photographs, so "
            "depth is coarse; give it more --seconds",
            LumigraphWarning,
            stacklevel=4,
        )
    sure = [agreed(maps, i, neighbours[i]) for i in range(len(maps))]
    return [depth_map(*one) for one in zip(maps, sure, photographs, strict=True)]


def improve(
    maps: Sequence[PlaneMap],
    i: int,
    neighbours: Sequence[int],
    level: MatchingLevel,
    geometric: bool,
    iterations: int,
    chance: torch.Generator,
) -> None:
    """Run one view's iterations at a level."""
    matching = PatchMatch(maps[i], [maps[j] for j in neighbours], chance, geometric)
    if level.first and not geometric:
        matching.begin()
    else:
        matching.choose(all_views=level.first)
    for k in range(iterations):
        matching.iterate(k if level.first and not geometric else k + 2, wide=level.first)


def affordable(views: Sequence[FlatView], spans: Sequence[tuple[float, float]], seconds: float) -> int:
    """Number of views for which the coarsest level fits into the time, measured by one view's random planes."""
    begin, middle = time.perf_counter(), len(views) // 2
    positions = torch.stack([view.pose[:, 3] for view in views])
    others = best_neighbours(middle, views, positions, spans[middle])
    if others:
        own, its = PlaneMap(views[middle], spans[middle]), [PlaneMap(views[j], spans[j]) for j in others]
        PatchMatch(own, its, torch.Generator(), geometric=False).begin()
    each = (time.perf_counter() - begin) * LEVELS[0].work * LEVELS[0].reduction ** 2 / HYPOTHESES
    return max(int(seconds / each), MIN_VIEWS)


def agreed(maps: Sequence[PlaneMap], i: int, neighbours: Sequence[int]) -> Bool[Tensor, "height width"]:
    """Mask of consistent pixels: their point lies on the planes of at least two neighbours that see it."""
    own = maps[i]
    depth = 1 / own.inverse_depth.flatten().clamp_min(1e-9)
    places = own.view.pose[:, 3] + depth[:, None] * own.view.rays.view(-1, 3)
    pixels, _ = own.view.project(places)
    count = torch.zeros(len(places), dtype=torch.int)
    for other in (maps[j] for j in neighbours):
        seen, row, column, away = other.view.sees(places)
        to_place = places - other.view.pose[:, 3]
        share = 1 / (other.planes[row, column] * (to_place @ other.view.pose[:, :3])).sum(-1)  # of the way to the plane
        back, depth_here = own.view.project(other.view.pose[:, 3] + share[:, None] * to_place)
        near = ((share - 1).abs() < DEPTH_TOLERANCE) & ((back - pixels).norm(dim=-1) < PIXEL_TOLERANCE)
        count += seen & near & (depth_here > 0)
    needed = MIN_AGREEING if len(neighbours) > MIN_AGREEING else 1
    sure = (count >= needed).view(own.cost.shape)
    return sure & (own.view.trust > 0.99) & (own.cost < MAX_SURE_COST)


def depth_map(found: PlaneMap, sure: Bool[Tensor, "height width"], number: int) -> DepthMap:
    """Depth map of a view, NaN for inconsistent pixels."""
    view = found.view
    height, width = view.trust.shape
    lens = Pinhole(view.intrinsics.diagonal()[None, :2], view.intrinsics[None, :2, 2])
    camera = Camera(view.pose[None], lens, torch.tensor([[width, height]]), image_index=torch.tensor([number]))
    depth = torch.where(sure, view.local_rays.norm(dim=-1) / found.inverse_depth, torch.nan)
    normals = -normalize(found.planes, dim=-1) @ view.pose[:, :3].T
    return DepthMap(camera, depth, sure.float(), view.rgb, normals)


def choose_neighbours(
    views: Sequence[FlatView], spans: Sequence[tuple[float, float]], count: int = NEIGHBOURS
) -> list[list[int]]:
    """Neighbours of each view: those with most overlap, at a suitable baseline."""
    positions = torch.stack([view.pose[:, 3] for view in views])
    return [best_neighbours(i, views, positions, spans[i], count) for i in range(len(views))]


def best_neighbours(
    i: int,
    views: Sequence[FlatView],
    positions: Float[Tensor, "view 3"],
    span: tuple[float, float],
    count: int = NEIGHBOURS,
) -> list[int]:
    """Neighbours of a view by their visibility of points on a coarse grid of pixels at some depths."""
    view = views[i]
    height, width = view.trust.shape
    grid = view.rays[height // 10 :: height // 5 + 1, width // 10 :: width // 5 + 1].reshape(-1, 3)
    depths = torch.logspace(math.log10(span[0]), math.log10(span[1]), 6)[1:-1]
    places = view.pose[:, 3] + (grid * depths[:, None, None]).reshape(-1, 3)
    here = normalize(places - view.pose[:, 3], dim=-1)
    scores = torch.zeros(len(views))
    for j, other in enumerate(views):
        there = normalize(places - positions[j], dim=-1)
        angle = (here * there).sum(-1).clamp(-1, 1).acos()
        off = (angle - MEETING_ANGLE) / torch.where(angle < MEETING_ANGLE, NARROWER, WIDER)
        scores[j] = (other.sees(places)[0] * torch.exp(-0.5 * off * off)).mean()
    scores[i] = 0
    order = scores.argsort(descending=True)[:count]
    return [j for j in order.tolist() if scores[j] > MIN_OVERLAP]
