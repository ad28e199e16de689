"""Consistency of planes within a view and between two views (Chen 2024)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d

from ...camera import Camera
from ...datasets.scene import Photograph
from ...depth_maps.flat_view import GREY
from ...geometry import unit
from .planes import MIN_FACING, PlaneMaps, normals_of

EDGE_POWER = 2  # of 1 - |gradient|, which weights the single-view term
DISC_EDGE_POWER = 5  # the same of a cloud that begins as discs
MIN_VARIANCE = 1e-4  # of grey values in a patch, below which it is flat and agrees with nothing
MAX_REPROJECTION = 1.0  # pixels; a pixel that returns farther away is hidden from one view, and left out
MAX_COST = 0.9  # 1 - NCC; a patch above it shows something else
TRUSTED_ALPHA = 0.99  # opacity of a photograph's pixels that patches may hold


@dataclass(frozen=True)
class PlaneView:
    """One photograph, in grey, and the planes that its camera sees."""

    camera: Camera
    grey: Float[Tensor, "height width"]
    maps: PlaneMaps


def grey_of(photograph: Photograph) -> Float[Tensor, "height width"]:
    """Brightness before black."""
    return photograph.before((0.0, 0.0, 0.0)) @ photograph.rgb.new_tensor(GREY)


def single_view_error(view: PlaneView, power: float = EDGE_POWER) -> Float[Tensor, ""]:
    """Edge-aware difference between the normals of depth and those of the planes:

        mean of (1 - |grad I|)^power |N_d - N|_1

    with |grad I| in [0, 1], over pixels inside the border; zero where a pixel or a neighbour crosses no plane."""
    maps, inner = view.maps, (slice(1, -1), slice(1, -1))
    whole = max_pool2d((~maps.crossed).float()[None], 3, 1)[0] == 0
    error = (normals_of(maps.depth, maps) * maps.opacity.detach()[inner][..., None] - maps.normals[inner]).abs().sum(-1)
    across, down = view.grey[1:-1, 2:] - view.grey[1:-1, :-2], view.grey[2:, 1:-1] - view.grey[:-2, 1:-1]
    edge = (across.square() + down.square()).sqrt()
    smooth = (1 - edge / edge.max().clamp_min(1e-6)) ** power
    return torch.where(whole, smooth * error, 0.0).mean()


def patch_centres(
    photograph: Photograph, maps: PlaneMaps, side: int, count: int, generator: torch.Generator
) -> tuple[Int[Tensor, " patch"], Int[Tensor, " patch"]]:
    """Rows and columns of random pixels that cross a plane, in the middle of patches of the photograph that are trusted
    and lie within the picture; at most `count`."""
    height, width = maps.opacity.shape
    there = torch.zeros_like(maps.crossed)
    half = side // 2
    if min(height, width) < side:
        row, column = there.nonzero().unbind(-1)
        return row, column
    trusted = torch.ones_like(there) if photograph.alpha is None else photograph.alpha > TRUSTED_ALPHA
    if photograph.mask is not None:
        trusted = trusted & photograph.mask
    whole = max_pool2d((~trusted).float()[None], side, 1)[0] == 0
    there[half : height - half, half : width - half] = whole
    places = (there & maps.crossed).nonzero()
    chosen = torch.randperm(len(places), generator=generator)[:count].to(places.device)
    row, column = places[chosen].unbind(-1)
    return row, column


def multi_view_errors(
    here: PlaneView,
    there: PlaneView,
    row: Int[Tensor, " patch"],
    column: Int[Tensor, " patch"],
    side: int,
    over_accepted: bool = True,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Photometric and geometric error between two views, at some pixels of the first.

        phi(p) = |p - p'|      p' by the plane here to the other view, and by the plane there back again
        L_rgb = mean of exp(-phi) (1 - NCC(patch around p, the same patch through p's plane))      L_geo likewise of phi

    over pixels with phi < 1; the weights get no gradient. L_rgb has the mean over patches that are whole and agree, or
    with `over_accepted` off over all, where the others count as zero.
    """
    maps, eye, other = here.maps, here.camera.position[0], there.camera.position[0]
    pixels = torch.stack([column, row], -1) + 0.5
    rays, depth = maps.rays[row, column], maps.depth[row, column]
    points = eye + depth[:, None] * rays
    place, valid = there.camera.project(points)
    seen = looked_up(torch.stack([there.maps.depth, there.maps.crossed.float()], -1), place)
    back, again = here.camera.project(other + seen[:, :1] * unit(points - other))
    offset = (back - pixels).square().sum(-1).clamp_min(1e-12).sqrt()
    kept = valid & again & inside(place, there.camera) & (seen[:, 1] > 0.99) & (offset < MAX_REPROJECTION)
    kept = kept.detach().nonzero()[:, 0]
    if not len(kept):
        return depth.sum() * 0, depth.sum() * 0
    weight = (-offset[kept]).exp().detach()
    geometric = (weight * offset[kept]).mean()

    half = side // 2
    steps = torch.arange(-half, half + 1, device=row.device)
    rows, columns = (x.flatten() for x in torch.meshgrid(steps, steps, indexing="ij"))
    rows, columns = row[kept, None] + rows, column[kept, None] + columns
    normals, around = unit(maps.normals[row[kept], column[kept]]), maps.rays[rows, columns]
    # The patch's rays cross the plane through the middle: t_q n . d_q = t_p n . d_p.
    along = (around @ normals[:, :, None])[:, :, 0].clamp(max=-MIN_FACING)
    far = depth[kept, None] * (rays[kept] * normals).sum(-1, keepdim=True) / along
    moved, valid = there.camera.project((eye + far[..., None] * around).flatten(0, 1))
    shown = looked_up(there.grey[..., None], moved)[:, 0].view(len(kept), -1)
    whole = (valid & inside(moved, there.camera)).view(len(kept), -1).all(-1)
    cost = 1 - correlation(here.grey[rows, columns], shown)
    accepted = whole & (cost < MAX_COST)
    count = accepted.sum().clamp_min(1) if over_accepted else len(cost)
    return torch.where(accepted, weight * cost, 0.0).sum() / count, geometric


def correlation(a: Float[Tensor, "patch pixel"], b: Float[Tensor, "patch pixel"]) -> Float[Tensor, " patch"]:
    """Zero-mean normalised cross-correlation of patches: cov(a, b) / sqrt((var a + e) (var b + e))"""
    a, b = a - a.mean(-1, keepdim=True), b - b.mean(-1, keepdim=True)
    spread = (a.square().mean(-1) + MIN_VARIANCE) * (b.square().mean(-1) + MIN_VARIANCE)
    return (a * b).mean(-1) / spread.sqrt()


def looked_up(
    values: Float[Tensor, "height width channel"], pixels: Float[Tensor, "point 2"]
) -> Float[Tensor, "point channel"]:
    """Values between pixels, bilinear; beyond the picture those of its border."""
    height, width = values.shape[:2]
    at = (2 * pixels / pixels.new_tensor([width, height]) - 1).nan_to_num(2.0, 2.0, -2.0)
    picture = values.movedim(-1, 0)[None]
    return grid_sample(picture, at[None, None], padding_mode="border", align_corners=False)[0, :, 0].T


def inside(pixels: Float[Tensor, "point 2"], camera: Camera) -> Bool[Tensor, " point"]:
    """Pixels between the centres of a picture's outer pixels."""
    return ((pixels >= 0.5) & (pixels <= camera.size - 0.5)).all(-1)


def near_views(cameras: Camera, index: int, count: int, angle: float) -> Int[Tensor, " near"]:
    """Indices of the cameras nearest to one, at another place, that look the same way up to an angle in degrees."""
    away = (cameras.position - cameras.position[index]).norm(dim=-1)
    alike = cameras.forward @ cameras.forward[index] > math.cos(math.radians(angle))
    away = torch.where(alike & (away > 1e-6), away, torch.inf)
    return away.argsort()[: min(count, int(away.isfinite().sum()))]
