"""Photographs of a mesh with exact geometry: a folder in Blender's layout, and the mesh in the same frame.

    python benchmarks/photographed.py bunny.obj OUTPUT

The surface has a solid texture of clouds and bands, so that it can be matched, and is matt under two lamps. The mesh is
normalised as `lumigraph train` normalises shapes (longest side from -0.9 to 0.9), and written as OUTPUT/truth.ply.
Cameras lie evenly on a sphere around it. Needs embreex besides Lumigraph.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
import tyro
from PIL import Image

from lumigraph.color.srgb import srgb_from_linear
from lumigraph.geometry import look_at
from lumigraph.readers.meshes import read_shape
from lumigraph.system.progress import track

DISTANCE, ANGLE = 3.2, 0.69  # of the cameras from the origin; of view, radians
SUBPIXELS = 3  # along each axis
LIGHTS = ((np.array([0.5, -0.6, 0.62]), 0.65), (np.array([-0.7, 0.5, 0.3]), 0.3))  # direction, strength
AMBIENT = 0.25
WAVES = 24  # plane waves of the solid texture
TO_OPENGL = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Options:
    mesh: tyro.conf.Positional[Path]
    output: tyro.conf.Positional[Path]
    views: int = 60
    held_out: int = 12
    size: int = 200
    seed: int = 0


def main(options: Options) -> None:
    shape = read_shape(options.mesh, options.mesh.stem)
    mesh = trimesh.Trimesh(shape.mesh.vertices, shape.mesh.faces, process=True)
    options.output.mkdir(parents=True)
    mesh.export(options.output / "truth.ply")
    random = np.random.default_rng(options.seed)
    texture = solid_texture(random)
    for split, count, turn in (("train", options.views, 0.0), ("test", options.held_out, 0.5)):
        frames = []
        (options.output / split).mkdir()
        for number, eye in enumerate(track(sphere(count, turn) * DISTANCE, split, count)):
            forward = torch.from_numpy(-eye / np.linalg.norm(eye))
            pose = look_at(torch.from_numpy(eye), forward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)).numpy()
            picture = photograph(mesh, texture, pose, options.size)
            name = f"{split}/r_{number:03d}"
            Image.fromarray(picture).save(options.output / f"{name}.png")
            matrix = np.eye(4)
            matrix[:3] = np.concatenate([pose[:, :3] @ TO_OPENGL, pose[:, 3:]], 1)
            frames.append({"file_path": f"./{name}", "transform_matrix": matrix.tolist()})
        text = json.dumps({"camera_angle_x": ANGLE, "frames": frames}, indent=1)
        (options.output / f"transforms_{split}.json").write_text(text)


def sphere(count: int, turn: float) -> np.ndarray:
    """Directions spread evenly over a sphere without its poles."""
    k = np.arange(count) + 0.5
    z, azimuth = 0.95 * (1 - 2 * k / count), (k + turn) * math.pi * (3 - math.sqrt(5))
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], -1)


def solid_texture(random: np.random.Generator):
    """Reflectance as a function of points: sums of plane waves at several frequencies, one sum for each colour."""
    directions = random.normal(size=(WAVES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    frequencies = np.geomspace(4, 40, WAVES)
    phases = random.uniform(0, 2 * math.pi, (WAVES, 3))
    strengths = random.normal(size=(WAVES, 3)) * frequencies[:, None] ** -0.35

    def reflectance(points: np.ndarray) -> np.ndarray:
        waves = np.cos((points @ directions.T * frequencies)[:, :, None] + phases)
        return 1 / (1 + np.exp(-1.3 * (waves * strengths).sum(1)))

    return reflectance


def photograph(mesh: trimesh.Trimesh, texture, pose: np.ndarray, size: int) -> np.ndarray:
    """One picture, RGBA bytes with straight alpha."""
    fine = size * SUBPIXELS
    focal = 0.5 * fine / math.tan(0.5 * ANGLE)
    x, y = np.meshgrid(np.arange(fine) + 0.5, np.arange(fine) + 0.5)
    local = np.stack([(x - fine / 2) / focal, (y - fine / 2) / focal, np.ones_like(x)], -1).reshape(-1, 3)
    directions = local @ pose[:, :3].T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(pose[:, 3], directions.shape)
    points, rays, faces = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    light = np.zeros((fine * fine, 4))
    if len(points):
        shares = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], points)
        normals = (mesh.vertex_normals[mesh.faces[faces]] * shares[:, :, None]).sum(1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        lit = AMBIENT + sum(strength * np.maximum(normals @ towards, 0) for towards, strength in LIGHTS)
        light[rays] = np.concatenate([texture(points) * lit[:, None], np.ones((len(points), 1))], 1)
    mean = light.reshape(size, SUBPIXELS, size, SUBPIXELS, 4).mean((1, 3))
    alpha = mean[..., 3:]
    straight = np.divide(mean[..., :3], alpha, where=alpha > 0, out=np.zeros_like(mean[..., :3]))
    colour = srgb_from_linear(straight).clip(0, 1)
    return np.round(255 * np.concatenate([colour, alpha], -1)).astype(np.uint8)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
