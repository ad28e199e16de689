"""Differentiable rasterisation of a mesh: colour, normals, depth and opacity of every pixel."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ... import kernels
from ...camera import Camera
from ...camera.lens import Mixed, OpenCV, Pinhole
from ...errors import LumigraphError


@dataclass(frozen=True)
class Picture:
    """Antialiased values over black of each pixel, and the depth of its centre.

    values:  attributes of vertices, times opacity
    opacity: coverage of the pixel by the mesh
    depth:   distance along the ray; infinity for empty centres
    """

    values: Float[Tensor, "height width channel"]
    opacity: Float[Tensor, "height width"]
    depth: Float[Tensor, "height width"]


def picture(
    vertices: Float[Tensor, "vertex 3"],
    attributes: Float[Tensor, "vertex channel"],
    faces: Int[Tensor, "face 3"],
    neighbours: Int[Tensor, "face 3"],
    camera: Camera,
    near: float,
) -> Picture:
    """The mesh seen by one camera, differentiable in vertices and attributes."""
    width, height = camera.size[0].tolist()
    corners = projected(vertices, camera)
    columns = torch.cat([attributes, torch.ones_like(attributes[:, :1])], -1)
    values, depth, found = kernels.rasterize_mesh(corners, columns, faces, (width, height), near)
    values = kernels.antialias(values, depth.detach(), found, corners, faces, neighbours)
    along = camera.cosines().clamp_min(1e-3)
    depth = torch.where(found >= 0, depth / along, torch.inf)
    return Picture(values[..., :-1], values[..., -1].clamp(0, 1), depth)


def projected(points: Float[Tensor, "point 3"], camera: Camera) -> Float[Tensor, "point 3"]:
    """Homogeneous pixels of points: pixels times depth, and depth. Lens distortion moves vertices; edges stay straight.
    Raises LumigraphError for lenses without a flat picture."""
    lens = camera.lens[0] if isinstance(camera.lens, Mixed) else camera.lens
    if not isinstance(lens, Pinhole | OpenCV):
        raise LumigraphError(
            f"A mesh is rasterised in a flat picture, and the lens here is {type(lens).__name__}; undistort the "
            "photographs, or convert the run to a method that follows any lens"
        )
    local = (points - camera.position[0]) @ camera.pose[0, :, :3]
    depth = local[:, 2:]
    straight = local[:, :2] * lens.focal[0] + lens.centre[0] * depth  # also behind the camera
    if isinstance(lens, OpenCV):
        pixels, valid = lens.project(local)
        straight = torch.where(valid[:, None], pixels * depth, straight)
    return torch.cat([straight, depth], -1)
