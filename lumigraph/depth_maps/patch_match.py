"""PatchMatch stereo: a slanted plane at every pixel of a picture (Galliani 2015; Schönberger 2016; Xu & Tao 2019).

A plane is the vector n = normal / distance in the camera's frame, so that a ray r = K^-1 (x, y, 1) meets it at the
inverse depth 1 / z = n · r. Alternately red and black pixels of a checkerboard try the planes of pixels of the other
colour and random perturbations of their own. A pixel keeps the plane with the least cost: the mean of the best
BEST_VIEWS of its neighbours, each one less the correlation of the windows plus, once the neighbours have depth, the
reprojection error between both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor
from torch.nn.functional import normalize

from .. import kernels
from .flat_view import FlatView

BEST_VIEWS = 2  # neighbours of least cost, whose mean counts: others may not see the place (Kang 2001)
CHOSEN_VIEWS = 3  # neighbours that are compared at each pixel once it has a plane
HYPOTHESES = 24  # random planes of a pixel at first, one in each of as many equal ranges of inverse depth
WINDOW_RADIUS, WINDOW_DEVIATION = 2, 0.1  # see `kernels.patch_cost`
GEOMETRIC_WEIGHT, MAX_REPROJECTION = 0.1, 3.0  # cost of a pixel of reprojection error, and its limit in pixels
MAX_COST = 2.0  # of planes outside the searched depths
DEPTH_MARGIN = 1.25  # factor beyond the searched depths up to which a plane may move
MIN_FACING = 0.2  # cosine between a plane's normal and the way to the camera
INITIAL_TILT = 0.5  # of random normals: deviation from the way to the camera, of unit length
DEPTH_CHANGE, RANGE_CHANGE = 0.02, 0.1  # random changes of inverse depth: of its own, and of the searched range
EPSILON = 1e-6


def turned(offsets: Sequence[tuple[int, int]]) -> list[list[tuple[int, int]]]:
    """Offsets rotated into all four directions."""
    return [[(a * x + b * y, a * y + b * x) for x, y in offsets] for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))]


# Areas of pixels of the other colour, (dx, dy); of each the plane of least cost is tried (Xu & Tao 2019, figure 3).
NEAR_AREAS = turned([(0, 1), (1, 2), (-1, 2), (2, 3), (-2, 3)])
FAR_AREAS = turned([(0, k) for k in (3, 5, 7, 9, 11, 15)])


@dataclass
class PlaneMap:
    """Planes of a view's pixels, and their costs.

    span: near and far limit of the depth search along the axis
    """

    view: FlatView
    span: tuple[float, float]
    planes: Float[Tensor, "height width 3"] = field(init=False)
    cost: Float[Tensor, "height width"] = field(init=False)

    def __post_init__(self) -> None:
        self.planes = torch.zeros_like(self.view.rgb)
        self.cost = torch.full_like(self.view.trust, math.inf)

    @property
    def inverse_depth(self) -> Float[Tensor, "height width"]:
        """Inverse depth along the axis."""
        return (self.planes * self.view.local_rays).sum(-1)

    def enlarged(self, view: FlatView) -> PlaneMap:
        """The planes at the pixels of a larger picture with the same pose."""
        pixels = view.local_rays @ self.view.intrinsics.T
        height, width = self.cost.shape
        column, row = pixels[..., 0].long().clamp(0, width - 1), pixels[..., 1].long().clamp(0, height - 1)
        larger = PlaneMap(view, self.span)
        larger.planes = self.planes[row, column]
        return larger


class PatchMatch:
    """One picture's planes, improved in place.

    geometric: also compare with the neighbours' own planes
    """

    def __init__(self, own: PlaneMap, others: Sequence[PlaneMap], chance: torch.Generator, geometric: bool):
        view, its = own.view, [other.view for other in others]
        self.own, self.view, self.chance, self.geometric = own, view, chance, geometric
        self.near, self.far = 1 / own.span[0], 1 / own.span[1]  # inverse
        self.rays = view.local_rays.view(-1, 3)
        self.focal = view.intrinsics.diagonal()[:2]
        self.warps = torch.stack([view.warp_to(other) for other in its])
        self.ways_back = torch.stack([other.warp_to(view) for other in its])
        self.pictures, self.trust = (padded([getattr(other, name) for other in its]) for name in ("grey", "trust"))
        self.all_views = torch.arange(len(others))
        self.chosen: Int[Tensor, "pixel view"] | None = None
        if geometric:
            self.its_planes = padded([other.planes for other in others])
            self.its_sizes = torch.tensor([other.cost.shape for other in others])
            self.its_rays = torch.stack([other.intrinsics.inverse() for other in its])

    # Costs

    def costs(
        self, pixels: Int[Tensor, " pixel"], planes: Float[Tensor, "pixel plane 3"], views: Int[Tensor, "pixel view"]
    ) -> Float[Tensor, "pixel plane view"]:
        """Costs of planes at pixels in each pixel's chosen neighbours."""
        inverse = (planes * self.rays[pixels, None]).sum(-1)
        placed = torch.cat([inverse[..., None], planes[..., :2] / self.focal], -1)
        pictures = self.view.grey, self.view.trust, self.pictures, self.trust
        cost = kernels.patch_cost(*pictures, self.warps, pixels, views, placed, WINDOW_RADIUS, WINDOW_DEVIATION)
        if self.geometric:
            cost += GEOMETRIC_WEIGHT * self.reprojection_error(pixels, inverse, views).clamp(max=MAX_REPROJECTION)
        outside = (inverse < self.far / DEPTH_MARGIN) | (inverse > self.near * DEPTH_MARGIN)
        return torch.where(outside[..., None], MAX_COST, cost)

    def reprojection_error(
        self, pixels: Int[Tensor, " pixel"], inverse: Float[Tensor, "pixel plane"], views: Int[Tensor, "pixel view"]
    ) -> Float[Tensor, "pixel plane view"]:
        """Forward-backward reprojection error in pixels, through a neighbour's plane (Schönberger 2016, eq. 9)."""
        width = self.view.trust.shape[1]
        x, y = (pixels % width + 0.5)[:, None, None], (pixels // width + 0.5)[:, None, None]
        u, v, there = warped(self.warps[views][:, None], x, y, inverse[..., None])
        size = self.its_sizes[views][:, None]
        there &= (u >= 0) & (v >= 0) & (u < size[..., 1]) & (v < size[..., 0])
        column, row = torch.where(there, u, 0).long(), torch.where(there, v, 0).long()
        places = torch.stack([u, v, torch.ones_like(u)], -1)[..., None, :]
        rays = (self.its_rays[views][:, None] * places).sum(-1)
        its = (self.its_planes[views[:, None], row, column] * rays).sum(-1)
        back_x, back_y, behind = warped(self.ways_back[views][:, None], u, v, its)
        return torch.where(there & behind, torch.hypot(back_x - x, back_y - y), MAX_REPROJECTION)

    @staticmethod
    def joined(costs: Float[Tensor, "pixel plane view"]) -> Float[Tensor, "pixel plane"]:
        """Mean of the least costs."""
        return costs.topk(min(BEST_VIEWS, costs.shape[-1]), -1, largest=False).values.mean(-1)

    # Iterations

    def begin(self) -> None:
        """Initialise with the best of random planes at each pixel."""
        count = len(self.rays)
        share = (torch.arange(HYPOTHESES) + torch.rand(count, HYPOTHESES, generator=self.chance)) / HYPOTHESES
        inverse = self.far + share * (self.near - self.far)
        self.keep(torch.arange(count), self.random(self.rays[:, None].expand(-1, HYPOTHESES, -1), inverse))

    def choose(self, all_views: bool) -> None:
        """Compute the costs of the planes; unless all_views, choose the views of least cost at each pixel."""
        pixels = torch.arange(len(self.rays))
        costs = self.costs(pixels, self.own.planes.view(-1, 1, 3), self.all_views.expand(len(pixels), -1))
        self.own.cost = self.joined(costs).view(self.own.cost.shape)
        if not all_views:
            count = min(CHOSEN_VIEWS, len(self.all_views))
            self.chosen = costs[:, 0].topk(count, 1, largest=False).indices

    def iterate(self, number: int, wide: bool) -> None:
        """Run propagation and random perturbation, red pixels before black ones.

        number: of the iteration; each halves the perturbations
        wide:   also try distant and wholly new planes
        """
        height, width = self.own.cost.shape
        odd = (torch.arange(height)[:, None] + torch.arange(width)) % 2
        for colour in (0, 1):
            pixels = (odd == colour).flatten().nonzero()[:, 0]
            areas = [*NEAR_AREAS, *FAR_AREAS] if wide else NEAR_AREAS
            best = torch.stack([self.best_in(area, pixels) for area in areas], 1)
            self.keep(pixels, self.own.planes.view(-1, 3)[best])
            self.keep(pixels, self.changed(pixels, 0.5**number, wide))

    def best_in(self, area: Sequence[tuple[int, int]], pixels: Int[Tensor, " pixel"]) -> Int[Tensor, " pixel"]:
        """Pixel of least cost in a propagation region of each pixel."""
        height, width = self.own.cost.shape
        dx, dy = torch.tensor(area).T
        row, column = (pixels // width)[:, None] + dy, (pixels % width)[:, None] + dx
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        index = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
        least = torch.where(inside, self.own.cost.view(-1)[index], math.inf).argmin(1, keepdim=True)
        return index.gather(1, least)[:, 0]

    def changed(self, pixels: Int[Tensor, " pixel"], amount: float, wide: bool) -> Float[Tensor, "pixel plane 3"]:
        """Random perturbations of pixels' own planes: of the depth, of the normal, and of both."""
        rays, own = self.rays[pixels], self.own.planes.view(-1, 3)[pixels]
        inverse, normals = (own * rays).sum(-1), -normalize(own, dim=-1)
        slightly = inverse * (1 + DEPTH_CHANGE * amount * self.uniform(len(pixels)))
        tilted = normalize(normals + amount * self.uniform(len(pixels), 3), dim=-1)
        planes = [facing(normals, rays, slightly), facing(tilted, rays, inverse), facing(tilted, rays, slightly)]
        if wide:
            span = self.near - self.far
            planes += [facing(normals, rays, inverse + RANGE_CHANGE * amount * span * self.uniform(len(pixels)))]
            planes += [self.random(rays, self.far + span * (0.5 + 0.5 * self.uniform(len(pixels))))]
        return torch.stack(planes, 1)

    def keep(self, pixels: Int[Tensor, " pixel"], planes: Float[Tensor, "pixel plane 3"]) -> None:
        """Keep planes of lower cost than the current ones."""
        views = self.all_views.expand(len(pixels), -1) if self.chosen is None else self.chosen[pixels]
        cost, index = self.joined(self.costs(pixels, planes, views.contiguous())).min(1)
        better = cost < self.own.cost.view(-1)[pixels]
        self.own.planes.view(-1, 3)[pixels[better]] = planes[better, index[better]]
        self.own.cost.view(-1)[pixels[better]] = cost[better]

    def random(self, rays: Float[Tensor, "*pixel 3"], inverse: Float[Tensor, "*pixel"]) -> Float[Tensor, "*pixel 3"]:
        """Planes at inverse depths, with random normals around the direction to the camera."""
        aside = INITIAL_TILT * torch.randn(rays.shape, generator=self.chance)
        return facing(normalize(aside - normalize(rays, dim=-1), dim=-1), rays, inverse)

    def uniform(self, *shape: int) -> Tensor:
        """Random numbers between -1 and 1."""
        return 2 * torch.rand(*shape, generator=self.chance) - 1


def facing(
    normals: Float[Tensor, "*pixel 3"], rays: Float[Tensor, "*pixel 3"], inverse: Float[Tensor, "*pixel"]
) -> Float[Tensor, "*pixel 3"]:
    """Planes through pixels at inverse depths; normals are first rotated towards the camera, to MIN_FACING."""
    back = -normalize(rays, dim=-1)
    cosine = (normals * back).sum(-1, keepdim=True)
    normals = normals + ((MIN_FACING - cosine) / (1 - MIN_FACING)).clamp_min(0) * back
    return normals * (inverse[..., None] / (normals * rays).sum(-1, keepdim=True))


def warped(warp: Tensor, x: Tensor, y: Tensor, inverse: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Warped pixels (u, v) of (x, y) at inverse depths (`kernels.patch_cost`), and a mask of those in front."""
    u, v, s = (
        warp[..., k, 0] * x + warp[..., k, 1] * y + warp[..., k, 2] + inverse * warp[..., k, 3] for k in range(3)
    )
    front = s > EPSILON
    s = torch.where(front, s, 1)
    return u / s, v / s, front


def padded(maps: Sequence[Shaped[Tensor, "_ _ *channels"]]) -> Shaped[Tensor, "map height width *channels"]:
    """Maps of any sizes stacked in one tensor, padded with zeros."""
    height, width = (max(one.shape[k] for one in maps) for k in (0, 1))
    out = maps[0].new_zeros(len(maps), height, width, *maps[0].shape[2:])
    for place, one in zip(out, maps, strict=True):
        place[: one.shape[0], : one.shape[1]] = one
    return out
