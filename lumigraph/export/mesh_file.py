"""Meshes as files: PLY, OBJ, GLB and USDZ, each with its colours where most programs look for them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float

from ..color.srgb import linear_from_srgb
from ..datasets.mesh import Mesh
from ..errors import LumigraphError
from ..exchange import gltf
from ..files import write_bytes
from ..geometry import to_quaternion, turning
from ..system.progress import counting
from .surface import vertex_normals
from .usdz import usdz

Z = np.array([0.0, 0.0, 1.0])


def write_mesh(path: Path, mesh: Mesh, up: Float[np.ndarray, " 3"] = Z) -> None:
    """Write in the format that the ending names, whole or not at all.

    .ply and .obj, which have no custom of what is up, are in the frame that the mesh is in. The other two stand
    upright, +y up; a .glb by a node that turns the vertices, which are in the mesh's own frame there too.

    up: in the mesh's frame
    .ply: binary, float32, sRGB-encoded bytes at each vertex
    .obj: sRGB-encoded colours from 0 to 1 after each vertex, as MeshLab, Blender and others read them
    .glb: linear colours, float32, and an unlit material, for the light is in the colours already
    .usdz: a picture of the colours, as `usdz` has it
    Raises LumigraphError for any other ending.
    """
    encode = ENCODERS[ending(path)]
    upright = turning(torch.from_numpy(np.asarray(up)), torch.tensor([0.0, 1.0, 0.0])).numpy()
    with counting(f"Writing {path.name}"):
        write_bytes(path, encode(mesh, upright), "mesh")


def ending(path: Path) -> str:
    """The ending of a mesh's file, in lower case. Raises LumigraphError for one that no mesh has."""
    if path.suffix.lower() not in ENCODERS:
        raise LumigraphError(f"{path} does not end like a mesh; name one that ends in {', '.join(ENCODERS)}")
    return path.suffix.lower()


def ply(mesh: Mesh, upright: Float[np.ndarray, "3 3"]) -> bytes:
    return bytes(as_trimesh(mesh).export(file_type="ply", vertex_normal=True))


def obj(mesh: Mesh, upright: Float[np.ndarray, "3 3"]) -> bytes:
    text = as_trimesh(mesh).export(file_type="obj", include_normals=True, digits=7, header="written by Lumigraph")
    return str(text).encode()


def glb(mesh: Mesh, upright: Float[np.ndarray, "3 3"]) -> bytes:
    """A binary glTF 2.0 of one mesh in its own frame, below a node that turns it upright."""
    columns = [
        gltf.Column(mesh.vertices.astype("<f4"), bounded=True),
        gltf.Column(vertex_normals(mesh.vertices, mesh.faces).astype("<f4")),
        gltf.Column(linear_from_srgb(mesh.colours / 255).astype("<f4")),
        gltf.Column(mesh.faces.astype("<u4").reshape(-1), target=gltf.INDICES),
    ]
    about = {
        "asset": {"version": "2.0", "generator": "Lumigraph"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {
                "name": "upright",
                "rotation": to_quaternion(torch.from_numpy(upright)).roll(-1).tolist(),  # glTF has w last
                "extras": {"source_from_upright": upright.T.tolist()},
                "children": [1],
            },
            {"name": "source", "mesh": 0},
        ],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, "indices": 3, "material": 0}]}
        ],
        "materials": [
            {
                "extensions": {"KHR_materials_unlit": {}},
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
            }
        ],
    }
    return gltf.encoded(about, columns)


def as_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    """For trimesh, which leaves vertices and their order as they are."""
    normals = vertex_normals(mesh.vertices, mesh.faces)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=normals, vertex_colors=mesh.colours, process=False)


ENCODERS = {".ply": ply, ".obj": obj, ".glb": glb, ".usdz": usdz}
