"""Sightings: what the cameras of a scene see of its surfaces, the common ground of meshes and points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from ..camera import Camera
from ..choice import evenly
from ..errors import LumigraphError
from ..geometry import look_at, normals_from_depth, unit
from ..method import Method
from ..progress import track
from . import depths

SOLID = 0.5  # opacity from which on a pixel shows a surface
ELEVATIONS = (0.0, 30.0, 60.0)  # degrees, of cameras around what has none of its own
SEERS = 16  # cameras of which one must see a point for it to count as seen
FAR = 1e6  # scene units: the depth of pixels that show none


@dataclass(frozen=True)
class Sighting:
    """One camera, and what it sees. Rows of pixels, on the CPU.

    depth:   distance along the ray, scene units; FAR where there is no surface
    opacity: share of light that the scene stops, in [0, 1]
    rgb:     sRGB-encoded, without the background
    normals: of the surface, unit length, towards the camera
    facing:  cosine between the surface's normal and the way back to the camera; 0 where there is no surface
    """

    camera: Camera
    depth: Float[Tensor, "height width"]
    opacity: Float[Tensor, "height width"]
    rgb: Float[Tensor, "height width 3"]
    normals: Float[Tensor, "height width 3"]
    facing: Float[Tensor, "height width"]


class Compared(NamedTuple):
    """Points beside what a camera sees.

    ahead:  how far the surface lies behind each point along its ray, scene units; negative for hidden points, NaN for
            points outside the picture
    smooth: whether the surface is one there, rather than an edge in front of something else
    pixels: where they are in the picture
    away:   distance from the camera, scene units
    """

    ahead: Float[Tensor, " point"]
    smooth: Bool[Tensor, " point"]
    pixels: Float[Tensor, "point 2"]
    away: Float[Tensor, " point"]


@torch.no_grad()
def look_around(method: Method, cameras: Camera, size: int = 400, most: int = 64) -> list[Sighting]:
    """What evenly chosen cameras see. Raises LumigraphError where they see no surface at all.

    size: longer side of the pictures at most, pixels
    most: cameras at most
    """
    chosen = evenly(range(len(cameras)), most)
    sightings = []
    for i in track(chosen, "Looking around", len(chosen)):
        camera = cameras[i].to("cpu")
        sightings.append(sighted(method, camera.resized(min(1.0, size / int(camera.size.max())))))
    if not any((seen.depth < FAR).any() for seen in sightings):
        raise LumigraphError(
            "No camera sees anything solid here, so there is no surface to export; train for longer and try again"
        )
    return sightings


def all_around(ring: Camera) -> Camera:
    """Cameras over a whole dome, at the distances and azimuths of a ring around the origin."""
    parts = []
    for degrees in ELEVATIONS:
        angle = torch.full((len(ring),), math.radians(degrees))
        flat = torch.nn.functional.normalize(ring.position[:, :2], dim=-1)
        outward = torch.cat([angle.cos()[:, None] * flat, angle.sin()[:, None]], -1)
        position = ring.position.norm(dim=-1, keepdim=True) * outward
        pose = look_at(position, -outward, torch.tensor([0.0, 0.0, 1.0]))
        parts.append(replace(ring, pose=pose))
    return Camera.cat(parts)


def sighted(method: Method, camera: Camera) -> Sighting:
    """What one camera sees."""
    seen = method.render(camera).cpu()
    background = torch.tensor(method.frame.background)
    solid = (seen.opacity > SOLID) & seen.depth.isfinite()
    covered = seen.opacity[..., None].clamp_min(SOLID)
    rgb = ((seen.rgb - (1 - seen.opacity[..., None]) * background) / covered).clamp(0, 1)
    depth = torch.where(solid, seen.depth, FAR)
    normals, facing = surface_normals(camera, depth)
    return Sighting(camera, depth, seen.opacity, rgb, normals, facing * solid)


def surface_normals(
    camera: Camera, depth: Float[Tensor, "height width"]
) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width"]]:
    """Unit normals towards the camera, from differences between pixels; and their cosine with the way back."""
    rays = camera.rays(camera.pixels())
    points = rays.at(depth.reshape(-1)).reshape(*depth.shape, 3)
    normals = normals_from_depth(points, depth)
    back = -rays.directions.reshape(normals.shape)
    facing = (normals * back).sum(-1)
    return normals * facing.sign()[..., None], facing.abs()


def compare(sighting: Sighting, points: Float[Tensor, "point 3"], jump: float) -> Compared:
    """Points beside the surface that a camera sees, whose depth is interpolated between pixels.

    jump: difference in depth between neighbouring pixels from which on there is an edge, scene units. There a point
          counts as seen only if it lies in front of both sides.
    """
    pixels, valid, away = located(sighting, points)
    ahead, smooth = torch.empty_like(away), torch.empty_like(valid)
    given = pixels, valid, away, sighting.depth
    depths.against(*(x.numpy() for x in given), jump, ahead.numpy(), smooth.numpy())
    return Compared(ahead, smooth, pixels, away)


def located(
    sighting: Sighting, points: Float[Tensor, "point 3"]
) -> tuple[Float[Tensor, "point 2"], Bool[Tensor, " point"], Float[Tensor, " point"]]:
    """Where points lie in a camera's picture, whether its lens sees them, and how far away they are."""
    pixels, valid = sighting.camera.project(points)
    return pixels, valid, (points - sighting.camera.position).norm(dim=-1)


def unseen(points: Float[Tensor, "point 3"], sightings: Sequence[Sighting], margin: float) -> Bool[Tensor, " point"]:
    """Whether points lie hidden from all cameras but a few, or outside all pictures.

    margin: how far behind a surface a point still counts as seen, scene units
    One camera in SEERS must see a point, and at least one: single depths err, at edges and beneath what shines.
    """
    needed = 1 + len(sightings) // SEERS
    left, count = torch.arange(len(points)), torch.zeros(len(points), dtype=torch.int64)
    for sighting in track(sightings, "Looking for what nobody sees", len(sightings)):
        count[left] += compare(sighting, points[left], margin).ahead >= -margin
        left = left[count[left] < needed]
    return count < needed


def look_up(values: Float[Tensor, "height width *channels"], pixels: Float[Tensor, "point 2"]) -> Tensor:
    """Values of the pixels that points (x, y) lie in; those outside take the nearest."""
    height, width = values.shape[:2]
    x, y = pixels.nan_to_num().floor().long().unbind(-1)
    return values[y.clamp(0, height - 1), x.clamp(0, width - 1)]


def colours(
    points: Float[Tensor, "point 3"],
    normals: Float[Tensor, "point 3"],
    sightings: Sequence[Sighting],
    tolerance: float,
) -> Float[Tensor, "point 3"]:
    """The colour of each point of a surface: the mean of what those cameras see that look at it squarely.

    A camera counts with the square of the cosine at which it looks, over the area that its pixel covers there. What no
    camera sees takes the colour of the nearest point that some camera does.
    tolerance: how far from a camera's own surface a point may lie to be seen by it, scene units
    """
    total, weight = torch.zeros(len(points), 3), torch.zeros(len(points))
    for sighting in track(sightings, "Colouring", len(sightings)):
        seen = compare(sighting, points, tolerance)
        back = unit(sighting.camera.position - points)
        cosine = (normals * back).sum(-1)
        good = seen.smooth & (seen.ahead.abs() < tolerance) & (cosine > 0.05)
        share = torch.where(good, (cosine / seen.away).square(), 0.0)
        total += share[:, None] * look_up(sighting.rgb, seen.pixels)
        weight += share
    known = weight > 0
    if not known.any():
        return torch.full_like(total, 0.5)
    found = total / weight.clamp_min(1e-12)[:, None]
    if not known.all():
        nearest = cKDTree(points[known].numpy()).query(points[~known].numpy())[1]
        found[~known] = found[known][torch.from_numpy(nearest)]
    return found
