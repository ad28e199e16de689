"""Readers of other packages, run by a Python that has them: packages.py NAME FILE RESULT.npz.

The result has what the package gives, in the file's axes: positions, quaternions (w, x, y, z), log_scales, opacities
from 0 to 1, colours (harmonics of degree 0) and rest (of higher degrees). It prints the version. It imports nothing of
Lumigraph.
"""

from __future__ import annotations

import importlib.metadata
import sys
from pathlib import Path
from typing import Any

import numpy as np

Found = dict[str, Any]


def of_logits(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-np.asarray(x, np.float64).reshape(-1)))


def gsply(path: Path) -> Found:
    import gsply

    data = gsply.read_spz(path) if path.suffix == ".spz" else gsply.plyread(path)
    return {
        "positions": data.means,
        "quaternions": data.quats,
        "log_scales": data.scales,
        "opacities": of_logits(data.opacities),
        "colours": data.sh0,
        "rest": data.shN,
    }


def sogpy(path: Path) -> Found:
    import SogPython

    rows = SogPython.read_ply(str(path))
    rows = getattr(rows, "columns", rows)
    column = {name: np.asarray(getattr(rows, "get_column", rows.__getitem__)(name)) for name in PLY}
    return of_columns(column)


PLY = [
    *"xyz",
    *(f"f_dc_{i}" for i in range(3)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
]


def of_columns(column: Any) -> Found:
    """From the names of the first release's .ply."""

    def stacked(*names: str) -> np.ndarray:
        return np.stack([np.asarray(column[name], np.float64) for name in names], -1)

    rest = sorted((name for name in column if name.startswith("f_rest_")), key=lambda name: int(name[7:]))
    found = {
        "positions": stacked(*"xyz"),
        "quaternions": stacked(*(f"rot_{i}" for i in range(4))),
        "log_scales": stacked(*(f"scale_{i}" for i in range(3))),
        "opacities": of_logits(column["opacity"]),
        "colours": stacked(*(f"f_dc_{i}" for i in range(3))),
    }
    if rest:
        found["rest"] = stacked(*rest).reshape(len(found["positions"]), 3, -1).transpose(0, 2, 1)
    return found


def open3d(path: Path) -> Found:
    import open3d

    if path.suffix in (".glb", ".obj", ".las") or not gaussians_in(path):
        return {"positions": np.asarray(open3d.io.read_triangle_mesh(str(path)).vertices)}
    point = open3d.t.io.read_point_cloud(str(path)).point
    names = {"quaternions": "rot", "log_scales": "scale", "colours": "f_dc", "rest": "f_rest"}
    found = {ours: point[theirs].numpy() for ours, theirs in names.items() if theirs in point}
    found["log_scales"] = np.log(found["log_scales"].astype(np.float64))  # it gives standard deviations
    return found | {"positions": point.positions.numpy(), "opacities": of_logits(point["opacity"].numpy())}


def gaussians_in(path: Path) -> bool:
    return path.suffix in (".spz", ".splat") or b"f_dc_0" in path.read_bytes()[:4000]


def trimesh(path: Path) -> Found:
    import trimesh

    found = trimesh.load(path, process=False, maintain_order=True)
    geometry = [*found.geometry.values()] if isinstance(found, trimesh.Scene) else [found]
    return {"positions": np.concatenate([np.asarray(one.vertices) for one in geometry])}


def usd(path: Path) -> Found:
    from pxr import Usd, UsdGeom, UsdVol

    stage, found = Usd.Stage.Open(str(path)), {}
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh):
            return {"positions": np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(), np.float64)}
        if prim.IsA(UsdVol.ParticleField3DGaussianSplat):
            values = {
                name: prim.GetAttribute(name).Get() for name in ("positions", "scales", "opacities", "orientations")
            }
            rotations = np.array([[q.real, *q.imaginary] for q in values["orientations"]])
            place = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim)).T
            harmonics = np.array(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get())
            harmonics = harmonics.reshape(len(rotations), -1, 3)
            found = {
                "positions": np.array(values["positions"], np.float64) @ place[:3, :3].T + place[:3, 3],
                "quaternions": rotations,
                "log_scales": np.log(np.array(values["scales"], np.float64)),
                "opacities": np.array(values["opacities"]),
                "colours": harmonics[:, 0],
                "rest": harmonics[:, 1:],
            }
    return found


KINDS = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
SPLATS = "KHR_gaussian_splatting"


def pygltflib(path: Path) -> Found:
    """Attributes by pygltflib's structures, at the translation of the node."""
    from pygltflib import GLTF2

    file = GLTF2().load(str(path))
    data, names = file.binary_blob(), vars(file.meshes[0].primitives[0].attributes)

    def numbers(name: str) -> np.ndarray:
        accessor = file.accessors[names[name]]
        view = file.bufferViews[accessor.bufferView]
        begin = (view.byteOffset or 0) + (accessor.byteOffset or 0)
        width, kind = WIDTHS[accessor.type], np.dtype(KINDS[accessor.componentType])
        return np.frombuffer(data, kind, accessor.count * width, begin).reshape(-1, width).astype(np.float64)

    node = next(node for node in file.nodes if node.mesh == 0)
    found = {"positions": numbers("POSITION") + np.array(node.translation or (0.0, 0.0, 0.0))}
    if f"{SPLATS}:SCALE" not in names:
        return found
    bands = [f"{SPLATS}:SH_DEGREE_{band}_COEF_{i}" for band in range(4) for i in range(2 * band + 1)]
    harmonics = np.stack([numbers(name) for name in bands if name in names], 1)
    return found | {
        "quaternions": np.roll(numbers(f"{SPLATS}:ROTATION"), 1, -1),
        "log_scales": np.log(numbers(f"{SPLATS}:SCALE")),
        "opacities": numbers(f"{SPLATS}:OPACITY")[:, 0],
        "colours": harmonics[:, 0],
        "rest": harmonics[:, 1:],
    }


def bpy(path: Path) -> Found:
    """Vertices of all meshes and clouds that Blender imports, in the file's frame (y up where Blender turned it)."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    importers = {
        ".glb": lambda: bpy.ops.import_scene.gltf(filepath=str(path)),
        ".ply": lambda: bpy.ops.wm.ply_import(filepath=str(path), forward_axis="Y", up_axis="Z"),
        ".obj": lambda: bpy.ops.wm.obj_import(filepath=str(path), forward_axis="Y", up_axis="Z"),
        ".usdz": lambda: bpy.ops.wm.usd_import(filepath=str(path)),
        ".usdc": lambda: bpy.ops.wm.usd_import(filepath=str(path)),
    }
    importers[path.suffix]()
    parts = []
    for one in bpy.data.objects:
        if one.type in ("MESH", "POINTCLOUD"):
            points = one.data.vertices if one.type == "MESH" else one.data.points
            matrix = np.array(one.matrix_world)
            parts.append(np.array([point.co for point in points]).reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3])
    places = np.concatenate(parts)
    return {"positions": places @ Y_UP.T if path.suffix in (".glb", ".usdz", ".usdc") else places}


Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # from z up


def laspy(path: Path) -> Found:
    import laspy

    file = laspy.read(path)
    return {"positions": np.stack([file.x, file.y, file.z], -1)}


READERS = {  # function and package
    "gsply": (gsply, "gsply"),
    "sogpy": (sogpy, "sogpy"),
    "Open3D": (open3d, "open3d"),
    "trimesh": (trimesh, "trimesh"),
    "usd-core": (usd, "usd-core"),
    "pygltflib": (pygltflib, "pygltflib"),
    "Blender (bpy)": (bpy, "bpy"),
    "laspy": (laspy, "laspy"),
}

if __name__ == "__main__":
    read, package = READERS[sys.argv[1]]
    if len(sys.argv) > 2:
        found = {name: np.asarray(x, np.float64) for name, x in read(Path(sys.argv[2])).items() if x is not None}
        np.savez(sys.argv[3], **found)
    print("version", importlib.metadata.version(package))
