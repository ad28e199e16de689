"""A ball, a box and more as meshes, made here: something small to learn distances from."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import torch
import trimesh

from lumigraph.datasets.dataset import splits_of
from lumigraph.datasets.mesh import Mesh
from lumigraph.datasets.shapes import Shape, Shapes, normalised

RADIUS = 0.9  # of the ball, once it is normalised


def made(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(np.array(shape.vertices), np.array(shape.faces), np.full((len(shape.vertices), 3), 160, np.uint8))


@cache
def ball() -> Shape:
    return normalised("ball", made(trimesh.creation.icosphere(subdivisions=3, radius=0.25)))


@cache
def box() -> Shape:
    return normalised("box", made(trimesh.creation.box((2.0, 1.0, 0.5))))


def shapes() -> Shapes:
    """What a method that learns from Shapes is tested on: a single ball."""
    return Shapes([ball()], {"train": torch.tensor([0]), "test": torch.tensor([0])}, "in memory")


def several() -> Shapes:
    return Shapes([ball(), box()], splits_of(2), "in memory")


def write(folder: Path) -> Path:
    """Three meshes as files: a ball, a box that is open on one side, and a cloud of points with normals."""
    folder.mkdir(parents=True, exist_ok=True)
    trimesh.creation.icosphere(subdivisions=2, radius=0.25).export(folder / "ball.obj")
    box = trimesh.creation.box((2.0, 1.0, 0.5))
    trimesh.Trimesh(box.vertices, box.faces[2:], process=False).export(folder / "box.ply")
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.25)
    rows = np.concatenate([ball.vertices, ball.vertex_normals], 1)
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    head = f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n{names}end_header\n"
    (folder / "cloud.ply").write_text(head + "".join(" ".join(f"{x:.7f}" for x in row) + "\n" for row in rows))
    return folder
