"""Web page with a draggable mesh lit by probes, in a rendered picture with depth."""

import gzip
import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..camera.lens import Pinhole
from ..composition.lit import MIN_SURFACE_OPACITY, ShadedMesh, surface_of
from ..datasets.mesh import Mesh
from ..datasets.scene import Frame, Vector
from ..errors import LumigraphError
from ..files import write_bytes
from ..light.probes import FREE, ProbeGrid
from ..method import Method
from ..paths import film_size
from ..paths.automatic import angle_of_view
from ..paths.opening import opening_of_scene
from ..readers.meshes import read_shape
from .page import page_bytes, webp

PICTURE_SIDE = 960  # pixels of the picture's longer side
PROBES_ACROSS = 32  # probes in a row of a texture
MESH_SHARE = 0.22  # longest side of the mesh, as a share of the box's shortest one
BALL_WHITE = 230  # of the default ball, sRGB-encoded
BALL_SUBDIVISIONS = 4
HELP = "Drag the mesh · scroll to resize it", "Drag the mesh"


def probes_page(
    path: Path,
    method: Method,
    camera: Camera,
    grid: ProbeGrid,
    title: str,
    mesh: Path | None = None,
    place: tuple[Vector, float] | None = None,
    side: int = PICTURE_SIDE,
) -> None:
    """Write the page. The picture is what a camera sees, flat; the mesh begins in its middle.

    camera: in the scene's frame
    mesh:   its file; None for a white ball
    place:  position of the mesh's middle in the scene's frame, and length of its longest side, where they are given
    side:   pixels of the picture's longer side
    """
    flat = flat_camera(camera, side).to("cpu")
    seen = method.render(flat.to(method.device)).cpu()
    solid = (seen.opacity > MIN_SURFACE_OPACITY) & seen.depth.isfinite()
    if not solid.any():
        raise LumigraphError("That view sees nothing solid to set a mesh on; give --view another photograph")
    depth = torch.where(solid, seen.depth, 0.0)
    points, normals = surface_of(flat, torch.where(solid, seen.depth, 1e6))
    shown = ball() if mesh is None else ShadedMesh.of(read_shape(mesh, mesh.stem).mesh)
    extent = shown.vertices.amax(0) - shown.vertices.amin(0)
    low, high = torch.tensor(method.frame.bounds)
    length = MESH_SHARE * float((high - low).min()) if place is None else place[1]
    scale = length / float(extent.max())
    lift = 0.5 * float(extent.max())
    position = middle_of(points, normals, solid, lift * scale) if place is None else torch.tensor(place[0])
    opaque = torch.cat([normals, torch.ones_like(normals[..., :1])], -1)
    arrays = {
        "depth": numbers(depth),
        "normals": ((opaque + 1) * 127.5).round().byte().numpy(),
        **textures(grid),
        "vertices": numbers(shown.vertices),
        "vertexNormals": numbers(shown.normals),
        "albedo": numbers(shown.albedo),
        "faces": shown.faces.numpy().astype("<u4"),
    }
    data, places = packed({"picture": webp(seen.rgb)} | {name: x.tobytes() for name, x in arrays.items()})
    lens = flat.lens
    assert isinstance(lens, Pinhole)
    settings = asdict(opening_of_scene(title, camera, method.frame)) | {
        "webgl": True,
        "packed": True,
        "near": 0.2 * method.frame.near,
        "parts": places,
        "size": flat.size[0].tolist(),
        "focal": lens.focal[0].tolist(),
        "pose": flat.pose[0].tolist(),
        "grid": grid_settings(grid, method.frame),
        "mesh": {"position": position.tolist(), "scale": scale, "lift": lift, "radius": shading_radius(shown)},
    }
    write_bytes(path, page_bytes("probes", settings, gzip.compress(data, 9, mtime=0), HELP), "page")


def shading_radius(mesh: ShadedMesh) -> float:
    """Radius of a ball that shades as a mesh does on average (Cauchy): pi r^2 is a quarter of its surface."""
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    area = float(torch.linalg.cross(b - a, c - a).norm(dim=-1).sum()) / 2
    return math.sqrt(area / (4 * math.pi))


def flat_camera(camera: Camera, side: int = PICTURE_SIDE) -> Camera:
    """A pinhole camera in place of any, with the same position, heading and shape of picture."""
    size = film_size(camera, side)
    focal = 0.5 * min(size) / math.tan(0.5 * angle_of_view(camera))
    middle = torch.tensor([[size[0] / 2, size[1] / 2]])
    return Camera(camera.pose, Pinhole(torch.full((1, 2), focal), middle), torch.tensor([size]))


def ball() -> ShadedMesh:
    """A white ball of radius 1."""
    made = trimesh.creation.icosphere(subdivisions=BALL_SUBDIVISIONS)
    vertices, faces = np.asarray(made.vertices, np.float64), np.asarray(made.faces, np.int64)
    return ShadedMesh.of(Mesh(vertices, faces, np.full(vertices.shape, BALL_WHITE, np.uint8)))


def middle_of(points: Tensor, normals: Tensor, solid: Tensor, lift: float) -> Float[Tensor, " 3"]:
    """A place above the level surface nearest to the middle of the picture, or above the middle's surface."""
    height, width = solid.shape
    y, x = torch.meshgrid(torch.arange(height) - height / 2, torch.arange(width) - width / 2, indexing="ij")
    level = solid & (normals[..., 2] > 0.8)
    away = torch.where(level if level.any() else solid, x**2 + y**2, torch.inf)
    row, column = divmod(int(away.argmin()), width)
    return points[row, column] + lift * normals[row, column]


def numbers(values: Tensor) -> np.ndarray:
    return values.numpy().astype("<f4")


def packed(parts: dict[str, bytes]) -> tuple[bytes, dict[str, tuple[int, int]]]:
    """All parts in one, each at a multiple of 4 bytes; where each begins, and its bytes."""
    data, places = b"", {}
    for name, part in parts.items():
        places[name] = len(data), len(part)
        data += part + bytes(-len(part) % 4)
    return data, places


def textures(grid: ProbeGrid) -> dict[str, np.ndarray]:
    """Light and distances of probes as the page's textures: a row of tiles has PROBES_ACROSS probes."""
    count, rows = len(grid), -(-len(grid) // PROBES_ACROSS)
    light = np.zeros((rows * PROBES_ACROSS, grid.radiance.shape[1], 4), "<f4")
    light[:count, :, :3] = grid.filled_radiance.numpy()
    light[:count, :, 3] = (grid.state == FREE).numpy()[:, None]
    wide = grid.mean.shape[1]
    maps = np.zeros((rows * PROBES_ACROSS, wide, wide, 2), "<f4")
    maps[:count] = torch.stack([grid.mean, grid.squared], -1).numpy()
    tiles = maps.reshape(rows, PROBES_ACROSS, wide, wide, 2).transpose(0, 2, 1, 3, 4)
    return {"light": light, "distances": np.ascontiguousarray(tiles)}


def grid_settings(grid: ProbeGrid, frame: Frame) -> dict[str, object]:
    """The grid's numbers for the page, seen from the scene's frame."""
    to_export, lengths = frame.to_export, grid.axes.double().norm(dim=-1)
    across = (grid.axes.double() / lengths[:, None] ** 2) @ to_export.matrix[:3, :3]
    offset = (grid.axes.double() / lengths[:, None] ** 2) @ (to_export.matrix[:3, 3] - grid.origin.double())
    cells = torch.cat([torch.cat([across, offset[:, None]], 1), torch.tensor([[0.0, 0.0, 0.0, 1.0]]).double()])
    return {
        "cells": cells.flatten().tolist(),
        "turn": to_export.rotation.flatten().tolist(),
        "steps": lengths.tolist(),
        "unit": to_export.scale,
        "counts": list(grid.counts),
        "coefficients": grid.radiance.shape[1],
        "side": grid.mean.shape[1] - 2,
        "across": PROBES_ACROSS,
        "far": grid.far,
    }
