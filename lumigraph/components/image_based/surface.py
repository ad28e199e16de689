"""Visible surface of a new camera, from depth maps of photographs around it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from ... import kernels
from ...camera import Camera
from ...camera.lens import OpenCV, Pinhole
from .depth import shape
from .kept_views import DepthGrid, KeptViews
from .warping import behind

AGREEMENT = 0.03  # of distance, within which two depth maps show one surface
MIN_SUPPORT = 0.5  # of the best supported surface's, that a nearer one needs to hide it
MAX_SPAN = 0.5  # of a picture's width: triangles that are longer go around a sphere the other way
EDGE_REACH = 0.5  # pixels of a depth map, by which a surface is continued beyond its edge


def warped(grid: DepthGrid, camera: Camera) -> tuple[Float[Tensor, "height width"], Float[Tensor, "height width"]]:
    """Distance and confidence of one photograph's surface in a new camera; confidence 0 without a surface."""
    height, width = shape(camera)
    pixels, valid = camera.project(grid.vertices)
    away = (grid.vertices - camera.position).norm(dim=-1)
    faces = grid.faces
    if not valid.all():
        faces = faces[valid[faces.long()].all(-1)]
    if not isinstance(camera.lens, Pinhole | OpenCV) and len(faces):
        x = pixels[:, 0][faces.long()]
        faces = faces[x.amax(-1) - x.amin(-1) < MAX_SPAN * width]
    corners = torch.cat([pixels * away[:, None], away[:, None]], -1)
    seen, distance, number = kernels.rasterize_mesh(corners, grid.confidence, faces, (width, height))
    return distance, torch.where(number >= 0, seen[..., 0], 0)


def surface_seen(
    views: KeptViews, chosen: Sequence[int], camera: Camera, closed: bool
) -> tuple[Float[Tensor, "height width"], Bool[Tensor, "height width"]]:
    """Distance to the surface at each pixel, and a mask of pixels with a surface in any photograph.

    The nearest surface with MIN_SUPPORT of the highest confidence is used; its distance is the mean of all that agree.
    Nearer photographs have more weight: at a photograph's position only its own depth counts.
    chosen: numbers of photographs, nearest first
    closed: fill in all pixels without a surface from around, farther surfaces first; else only pixels beside a surface,
            where alpha shows its edge more finely than the depth maps
    """
    maps = [warped(views.grid(i), camera) for i in chosen]
    near = nearness(views, chosen, camera)
    distance = torch.stack([one for one, _ in maps])
    weight = torch.stack([confidence * share for (_, confidence), share in zip(maps, near, strict=True)])
    depth, known = consensus(distance, weight), weight.sum(0) > 0
    if not known.any():
        return depth + torch.inf, known
    depth = behind(depth[..., None], depth, known)[..., 0]
    if closed:
        return depth, torch.ones_like(known)
    reach = math.ceil(EDGE_REACH * max(1.0, max(depth.shape) / views.depth_size))
    known = max_pool2d(known[None].float(), 2 * reach + 1, 1, reach)[0] > 0
    return torch.where(known, depth, torch.inf), known


def nearness(views: KeptViews, chosen: Sequence[int], camera: Camera) -> list[float]:
    """Weights of photographs by their distance from a camera; 1 for the nearest."""
    tables = views.tables
    apart = (tables.cameras.position[list(chosen)] - camera.position).norm(dim=-1) / tables.middle
    return (1 / (1e-4 + apart * apart)).div(1 / (1e-4 + apart.min() ** 2)).tolist()


def consensus(
    distance: Float[Tensor, "map height width"], weight: Float[Tensor, "map height width"]
) -> Float[Tensor, "height width"]:
    """Distance of the nearest well supported surface; 0 without one."""
    support = [(weight * ((distance - one).abs() < AGREEMENT * one)).sum(0) for one in distance]
    best = MIN_SUPPORT * torch.stack(support).amax(0)
    nearest = torch.full_like(distance[0], torch.inf)
    for one, its, counts in zip(distance, support, weight, strict=True):
        nearest = torch.where((counts > 0) & (its >= best), torch.minimum(nearest, one), nearest)
    agreeing = weight * ((distance - nearest).abs() < AGREEMENT * nearest)
    return (agreeing * distance).sum(0) / agreeing.sum(0).clamp_min(1e-12)
