"""Pictures of shapes: their shaded grey surface for a camera."""

import torch

from ...camera import Camera
from ..scene import Photograph
from . import Shape

SURFACE_POINTS = 60_000  # points of a surface that its picture is made of
AMBIENT, DIFFUSE = 0.25, 0.65  # of the grey surface in light from the camera


def picture_of(shape: Shape, camera: Camera, generator: torch.Generator) -> Photograph:
    """A shaded grey shape with transparent background: the nearest of many surface points in each pixel."""
    surface = shape.surface(SURFACE_POINTS, generator)
    width, height = camera.size[0].tolist()
    pixels, visible = camera.project(surface.points)
    towards = surface.points - camera.position
    depth = towards.norm(dim=-1)
    x, y = pixels.long().unbind(-1)
    seen = visible & (x >= 0) & (y >= 0) & (x < width) & (y < height) & (pixels >= 0).all(-1)
    place, distance = (y * width + x)[seen], depth[seen]
    nearest = torch.full((height * width,), torch.inf).scatter_reduce(0, place, distance, "amin")
    first = torch.full((height * width,), -1)
    front = (distance == nearest[place]).nonzero()[:, 0]
    first[place[front]] = seen.nonzero()[:, 0][front]
    alpha, shade = (first >= 0).float(), torch.zeros(height * width)
    if surface.normals is not None:
        facing = (surface.normals * towards).sum(-1).abs() / depth
        shade[first >= 0] = AMBIENT + DIFFUSE * facing[first[first >= 0]]
    rgb = shade.view(height, width, 1).expand(-1, -1, 3)
    return Photograph(camera, rgb, alpha.view(height, width))
