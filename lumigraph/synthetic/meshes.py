"""Meshes from files in a procedural world: every triangle a thin plate, photographed as any other object is."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..capture import meshes
from ..errors import LumigraphError
from .categories import surrounded
from .shapes import triangle_of
from .stage import SyntheticStage
from .textures import Plain
from .world import Material, Object, Pose, Vector, nested

RADIUS = 0.85  # of the ball around a mesh, about its middle
THICKNESS = 4e-3  # of its triangles
BOUNDS: tuple[Vector, Vector] = ((-RADIUS,) * 3, (RADIUS,) * 3)


def mesh_stage(path: Path, size: int, views: int, seed: int) -> SyntheticStage:
    """Stage with one file's mesh, centred at the origin, photographed like members of categories. seed: of the cameras

    Raises LumigraphError for a file that holds no surface.
    """
    random = np.random.default_rng((seed, zlib.crc32(path.name.encode())))
    return surrounded(tuple(plates(path)), BOUNDS, size, views, random)


def plates(path: Path) -> Iterator[Object]:
    """Its triangles, in the mean colours of their corners."""
    mesh = meshes.read_shape(path, path.stem).mesh
    if not len(mesh.faces):
        raise LumigraphError(f"{path} holds points and no surface, of which there is nothing to photograph")
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    points = mesh.vertices - 0.5 * (low + high)
    points = points * ((RADIUS - THICKNESS) / np.linalg.norm(points, axis=1).max())
    for face in mesh.faces:
        if (plate := triangle_of(points[face].astype(float), THICKNESS)) is not None:
            shape, rotation, position = plate
            red, green, blue = (mesh.colours[face].mean(0) / 255).round(3).tolist()
            paint = Material(Plain((red, green, blue)), gloss=0.3, roughness=0.5)
            yield Object(shape, paint, Pose(tuple(position.tolist()), nested(rotation)), path.stem)
