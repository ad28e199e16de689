"""Mesh files: PLY, OBJ, GLB and USDZ, each with colours or texture in the form that most programs read."""

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float, UInt8
from PIL import Image

from ..color.srgb import linear_from_srgb
from ..color.tags import srgb_bytes
from ..datasets.mesh import Mesh, MeshTexture
from ..datasets.scene import GeographicOrigin
from ..errors import LumigraphError
from ..exchange import gltf
from ..files import write_bytes
from ..files.ply import NAMES
from ..geometry import is_far, to_quaternion, turning
from ..system.progress import counting
from .surface import Triangles, tangents, vertex_normals
from .usdz import png, usdz

Z = np.array([0.0, 0.0, 1.0])
JPEG_QUALITY = 92  # of a texture's colours in a .glb
CLAMP_TO_EDGE = 33071  # glTF's sampler: texels beyond the picture


@dataclass(frozen=True)
class MeshFile:
    """A mesh to write, with options.

    name:    of the file, without its suffix
    upright: rotation of up, in the mesh's frame, to +y
    lit:     whether a viewer's lights apply to it; otherwise it is emissive
    origin:  of the mesh's frame on Earth, if known
    pieces:  further triangles without colours, in the same frame, by name
    """

    name: str
    mesh: Mesh
    upright: Float[np.ndarray, "3 3"]
    lit: bool = False
    origin: GeographicOrigin | None = None
    pieces: Mapping[str, Triangles] = field(default_factory=dict)

    @cached_property
    def offset(self) -> Float[np.ndarray, " 3"] | None:
        """Place near the vertices, where they are too far from the origin for float32; None near it."""
        vertices, faces = self.mesh.vertices, self.mesh.faces
        if not len(faces):
            return None
        edge = float(np.median(np.linalg.norm(vertices[faces[:, 1]] - vertices[faces[:, 0]], axis=1)))
        return np.median(vertices, 0).round() if is_far(vertices, edge) else None

    @property
    def normals(self) -> Float[np.ndarray, "vertex 3"]:
        """Unit normals at vertices, the same for all copies of a vertex split by a texture."""
        if self.mesh.texture is None:
            return vertex_normals(self.mesh.vertices, self.mesh.faces)
        places, same = np.unique(self.mesh.vertices, axis=0, return_inverse=True)
        return vertex_normals(places, same.reshape(-1)[self.mesh.faces])[same.reshape(-1)]


def write_mesh(
    path: Path,
    mesh: Mesh,
    up: Float[np.ndarray, " 3"] = Z,
    *,
    lit: bool = False,
    origin: GeographicOrigin | None = None,
    pieces: Mapping[str, Triangles] | None = None,
) -> list[Path]:
    """Write in the format that the ending names, each file whole or not at all. Returns the files.

    .ply and .obj, which have no convention for up, are in the frame of the mesh. The other two are
    upright, +y up; a .glb by a node that turns the vertices, which are in the mesh's own frame there too.

    up: in the mesh's frame
    lit: whether the lights of a viewer act on the mesh: the colours already contain the light of the scene
    origin: of the mesh's frame on Earth, in comments (.ply) or extras (.glb)
    pieces: further triangles by name, in a .glb alone
    .ply: binary, float32, sRGB-encoded bytes at each vertex
    Far from the origin .ply and .obj have places in double precision, .glb nodes with a translation
    .obj: sRGB-encoded colours from 0 to 1 after each vertex, as MeshLab, Blender and others read them; with a texture
          its places, and beside it .mtl, .png and -normals.png
    .glb: linear colours, float32, or a texture inside the file
    .usdz: a picture of the colours, or the texture, as `usdz` has it
    Raises LumigraphError for any other ending, and for a texture in a .ply.
    """
    encode = ENCODERS[ending(path, mesh.texture is not None)]
    upright = turning(torch.from_numpy(np.asarray(up)), torch.tensor([0.0, 1.0, 0.0])).numpy()
    parts = encode(MeshFile(path.stem, mesh, upright, lit, origin, pieces or {}))
    written = [path.with_name(unbroken(path.stem) + end) if end else path for end in parts]
    with counting(f"Writing {path.name}"):
        for file, data in zip(written, parts.values(), strict=True):
            write_bytes(file, data, "mesh")
    return written


def ending(path: Path, texture: bool = False) -> str:
    """Suffix of a mesh file, in lower case. Raises LumigraphError for an unknown one."""
    end = path.suffix.lower()
    if end not in ENCODERS:
        raise LumigraphError(f"{path} does not end like a mesh; name one that ends in {', '.join(ENCODERS)}")
    if texture and end == ".ply":
        raise LumigraphError(f"{path} cannot hold a texture; name one that ends in .glb, .obj or .usdz")
    return end


def files_of(path: Path, texture: bool) -> list[Path]:
    """All files written for a mesh of this name. Raises LumigraphError as `ending` does."""
    further = (MATERIAL, PICTURE, NORMALS) if texture and ending(path, texture) == ".obj" else ()
    return [path, *(path.with_name(unbroken(path.stem) + end) for end in further)]


def unbroken(name: str) -> str:
    """A name that an .obj can state: many programs end it at the first blank."""
    return "_".join(name.split())


WITH_ORIGIN = ".ply", ".glb"  # endings of files that hold the frame's origin on Earth
Parts = dict[str, bytes]  # contents of files, by what follows the name without its ending; "" for the file itself
MATERIAL, PICTURE, NORMALS = ".mtl", ".png", "-normals.png"


def ply(file: MeshFile) -> Parts:
    data = exact_ply(file) if file.offset is not None else as_trimesh(file).export(file_type="ply", vertex_normal=True)
    *first, rest = bytes(data).split(b"\n", 2)
    comments = ["written by Lumigraph", *([] if file.origin is None else [file.origin.sentence])]
    return {"": b"\n".join([*first, *(f"comment {text}".encode() for text in comments), rest])}


def exact_ply(file: MeshFile) -> bytes:
    """The same layout with places in double precision."""
    mesh = file.mesh
    kinds = {"x": "f8", "y": "f8", "z": "f8", "nx": "f4", "ny": "f4", "nz": "f4"} | dict.fromkeys(
        ("red", "green", "blue"), "u1"
    )
    rows = np.empty(len(mesh.vertices), [(name, f"<{kind}") for name, kind in kinds.items()])
    for name, column in zip(kinds, [*mesh.vertices.T, *file.normals.T, *mesh.colours[:, :3].T], strict=True):
        rows[name] = column
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property {NAMES[kind][0]} {name}" for name, kind in kinds.items()]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(lines).encode() + rows.tobytes() + faces.tobytes()


def obj(file: MeshFile) -> Parts:
    if file.mesh.texture is not None:
        return textured_obj(file, file.mesh.texture)
    text = as_trimesh(file).export(file_type="obj", include_normals=True, digits=7, header="written by Lumigraph")
    return {"": str(text).encode()}


def textured_obj(file: MeshFile, texture: MeshTexture) -> Parts:
    """Text of an OBJ file, of its material, and their pictures. OBJ's v points upwards."""
    held, name = io.StringIO(), unbroken(file.name)
    numbers = np.repeat(file.mesh.faces.reshape(-1, 1) + 1, 3, 1).reshape(-1, 9)
    held.write(f"# written by Lumigraph\nmtllib {name}{MATERIAL}\nusemtl surface\n")
    np.savetxt(held, file.mesh.vertices, "v %.9g %.9g %.9g" if file.offset is None else "v %.14g %.14g %.14g")
    np.savetxt(held, texture.uv * [1, -1] + [0, 1], "vt %.7g %.7g")
    np.savetxt(held, file.normals, "vn %.5g %.5g %.5g")
    np.savetxt(held, numbers, "f " + " ".join(["%d/%d/%d"] * 3))
    colour = "Kd 1 1 1" if file.lit else "Kd 1 1 1\nKa 0 0 0\nillum 0"
    lines = ["# written by Lumigraph", "newmtl surface", colour, f"map_Kd {name}{PICTURE}"]
    parts = {"": held.getvalue().encode(), MATERIAL: b"", PICTURE: png(texture.colours)}
    if texture.normals is not None:
        parts[NORMALS] = png(texture.normals, colours=False)
        lines.append(f"norm {name}{NORMALS}")
    return parts | {MATERIAL: "".join(line + "\n" for line in lines).encode()}


def glb(file: MeshFile) -> Parts:
    """A binary glTF 2.0 of one mesh in its own frame, below a node that turns it upright."""
    mesh, base = file.mesh, np.zeros(3) if file.offset is None else file.offset
    place = {} if file.offset is None else {"translation": base.tolist()}
    columns = {
        "POSITION": gltf.Column((mesh.vertices - base).astype("<f4"), bounded=True),
        "NORMAL": gltf.Column(file.normals.astype("<f4")),
    }
    coloured, material, pictures = appearance(file)
    columns |= coloured
    about: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "Lumigraph"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {
                "name": "upright",
                "rotation": to_quaternion(torch.from_numpy(file.upright)).roll(-1).tolist(),  # glTF has w last
                "extras": {"source_from_upright": file.upright.T.tolist()},
                "children": [1],
            },
            {"name": "source", "mesh": 0, **place},
        ],
        "meshes": [
            {
                "name": "source",
                "primitives": [
                    {"attributes": {name: i for i, name in enumerate(columns)}, "indices": len(columns), "material": 0}
                ],
            }
        ],
        "materials": [material],
    }
    if not file.lit:
        about["extensionsUsed"] = ["KHR_materials_unlit"]
    if file.origin is not None:
        about["nodes"][1]["extras"] = {"reference": file.origin.sentence, "origin": file.origin.to_json()}
    if pictures:
        about["samplers"] = [{"wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE}]
        about["textures"] = [{"source": i, "sampler": 0} for i in range(len(pictures))]
    every = [*columns.values(), gltf.Column(mesh.faces.astype("<u4").reshape(-1), target=gltf.INDICES)]
    for name, (vertices, faces) in file.pieces.items():
        about["nodes"][0]["children"].append(len(about["nodes"]))
        about["nodes"].append({"name": name, "mesh": len(about["meshes"]), **place})
        primitive = {"attributes": {"POSITION": len(every)}, "indices": len(every) + 1}
        about["meshes"].append({"name": name, "primitives": [primitive]})
        every.append(gltf.Column((vertices - base).astype("<f4"), bounded=True))
        every.append(gltf.Column(faces.astype("<u4").reshape(-1), target=gltf.INDICES))
    return {"": gltf.encoded(about, every, pictures)}


def appearance(file: MeshFile) -> tuple[dict[str, gltf.Column], dict[str, Any], list[tuple[str, bytes]]]:
    """Columns of colours or of a texture's places, the material, and its pictures."""
    mesh, texture = file.mesh, file.mesh.texture
    material: dict[str, Any] = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}
    pictures: list[tuple[str, bytes]] = []
    if texture is None:
        columns = {"COLOR_0": gltf.Column(linear_from_srgb(mesh.colours / 255).astype("<f4"))}
    else:
        columns = {"TEXCOORD_0": gltf.Column(texture.uv.astype("<f4"))}
        pictures.append(("image/jpeg", jpeg(texture.colours)))
        material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
        if texture.normals is not None:
            frame = tangents(mesh.vertices, mesh.faces, texture.uv, file.normals)
            columns["TANGENT"] = gltf.Column(frame.astype("<f4"))
            pictures.append(("image/png", png(texture.normals, colours=False)))
            material["normalTexture"] = {"index": 1}
    if not file.lit:
        material["extensions"] = {"KHR_materials_unlit": {}}
    return columns, material, pictures


def jpeg(picture: UInt8[np.ndarray, "height width 3"]) -> bytes:
    return srgb_bytes(Image.fromarray(picture), "JPEG", quality=JPEG_QUALITY, subsampling=0)


def as_trimesh(file: MeshFile) -> trimesh.Trimesh:
    """For trimesh, which leaves vertices and their order as they are."""
    mesh = file.mesh
    return trimesh.Trimesh(
        mesh.vertices, mesh.faces, vertex_normals=file.normals, vertex_colors=mesh.colours, process=False
    )


def phone(file: MeshFile) -> Parts:
    return {"": usdz(file.mesh, file.normals, file.upright, file.lit)}


ENCODERS: dict[str, Callable[[MeshFile], Parts]] = {".ply": ply, ".obj": obj, ".glb": glb, ".usdz": phone}
