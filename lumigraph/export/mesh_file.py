"""Meshes as files: PLY, OBJ, GLB and USDZ, each with its colours where most programs read them.

USDZ is what phones and tablets open in space. They draw no colours of vertices, so the colours are in a picture: two by
two texels for each triangle, between whose centres a GPU interpolates as between vertices. The layer in the archive is
text, so no library of USD is needed.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from string import Template

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int, UInt8
from PIL import Image

from ..color.srgb import linear_from_srgb
from ..datasets.mesh import Mesh
from ..errors import LumigraphError
from ..exchange import gltf
from ..exchange.codes import morton_order
from ..files import write_bytes
from ..geometry import to_quaternion, turning
from ..system.progress import counting
from .surface import vertex_normals

ALIGNMENT_BYTES = 64  # of every file's data in the archive (Usdz File Format Specification 1.3, "Layout")
ZIP_HEADER_BYTES = 30  # bytes of a zip file's header before the name
PADDING = b"\x19\x86"  # id of an extra field, which readers ignore
PICTURE = "colours.png"

# Light of its own and no other: the light of the scene is in its colours already. Phones take emission for sRGB.
LAYER = Template("""#usda 1.0
(
    customLayerData = {
        matrix4d sourceFromUpright = $source
        string creator = "Lumigraph"
    }
    defaultPrim = "Scene"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "Scene" (
    kind = "component"
)
{
    def Mesh "Mesh" (
        prepend apiSchemas = ["MaterialBindingAPI"]
    )
    {
        uniform bool doubleSided = 1
        uniform token subdivisionScheme = "none"
        float3[] extent = [$extent]
        int[] faceVertexCounts = [$counts]
        int[] faceVertexIndices = [$corners]
        point3f[] points = [$points]
        texCoord2f[] primvars:st = [$places] (
            interpolation = "faceVarying"
        )
        rel material:binding = </Scene/Material>
    }

    def Material "Material"
    {
        token outputs:surface.connect = </Scene/Material/Surface.outputs:surface>

        def Shader "Surface"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor = (0, 0, 0)
            color3f inputs:emissiveColor.connect = </Scene/Material/Colours.outputs:rgb>
            float inputs:metallic = 0
            float inputs:roughness = 1
            token outputs:surface
        }

        def Shader "Colours"
        {
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @$picture@
            token inputs:sourceColorSpace = "sRGB"
            float2 inputs:st.connect = </Scene/Material/Places.outputs:result>
            token inputs:wrapS = "clamp"
            token inputs:wrapT = "clamp"
            float3 outputs:rgb
        }

        def Shader "Places"
        {
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }
    }
}
""")


def usdz(mesh: Mesh, upright: Float[np.ndarray, "3 3"]) -> bytes:
    """A USDZ archive of one mesh, y up, the middle of its base at the origin, a unit of the mesh for a metre.

    upright: the rotation that brings up, in the mesh's frame, to +y
    """
    turned = mesh.vertices @ upright.T
    low, high = turned.min(0), turned.max(0)
    base = np.array([0.5 * (low[0] + high[0]), low[1], 0.5 * (low[2] + high[2])])
    source_from_upright = np.eye(4)
    source_from_upright[:3, :3], source_from_upright[:3, 3] = upright.T, upright.T @ base
    picture, places = baked(mesh)
    layer = LAYER.substitute(
        source=f"({tuples(source_from_upright.T, '%.17g')})",  # USD multiplies rows from the left
        extent=tuples(np.stack([low, high]) - base),
        counts=", ".join(["3"] * len(mesh.faces)),
        corners=", ".join(map(str, mesh.faces.reshape(-1).tolist())),
        points=tuples(turned - base),
        places=tuples(places.reshape(-1, 2), "%.6g"),
        picture=PICTURE,
    )
    held = io.BytesIO()
    Image.fromarray(picture).save(held, "PNG")
    return archive({"scene.usda": layer.encode(), PICTURE: held.getvalue()})


def baked(mesh: Mesh) -> tuple[UInt8[np.ndarray, "height width 3"], Float[np.ndarray, "face 3 2"]]:
    """A picture of the triangles' colours, and where on it their corners are: from its lower left corner, in [0, 1].

    With colours a, b, c at texels (0, 0), (1, 0), (0, 1) and b + c - a at (1, 1), bilinear interpolation is linear.
    Triangles that are neighbours in space are neighbours on the picture, so that it may be made smaller, too.
    """
    count = len(mesh.faces)
    rank = np.empty(count, np.int64)
    rank[morton_order(mesh.vertices[mesh.faces].mean(1))] = np.arange(count)
    x, y = (2 * along for along in z_curve(rank))
    width, height = int(x.max()) + 2, int(y.max()) + 2
    a, b, c = np.moveaxis(mesh.colours[mesh.faces].astype(np.int64), 1, 0)
    picture = np.zeros((height, width, 3), np.uint8)
    for dx, dy, colour in ((0, 0, a), (1, 0, b), (0, 1, c), (1, 1, (b + c - a).clip(0, 255))):
        picture[y + dy, x + dx] = colour
    texels = np.stack([x, y], -1)[:, None] + np.array([[0.5, 0.5], [1.5, 0.5], [0.5, 1.5]])
    return picture, texels / [width, -height] + [0, 1]


def z_curve(rank: Int[np.ndarray, " place"]) -> tuple[Int[np.ndarray, " place"], Int[np.ndarray, " place"]]:
    """Columns and rows of places along a Z-curve through a square: even and odd bits (Morton 1966)."""
    x, y = np.zeros_like(rank), np.zeros_like(rank)
    for bit in range(20):
        x |= (rank >> 2 * bit & 1) << bit
        y |= (rank >> 2 * bit + 1 & 1) << bit
    return x, y


def tuples(rows: Iterable[Iterable[float]], form: str = "%.7g") -> str:
    return ", ".join(f"({', '.join(form % value for value in row)})" for row in np.asarray(rows).tolist())


def archive(parts: Mapping[str, bytes]) -> bytes:
    """A zip archive that holds files as they are, in this order, each beginning at a multiple of 64 bytes."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_STORED) as packed:
        for name, data in parts.items():
            about = zipfile.ZipInfo(name)
            header = held.tell() + ZIP_HEADER_BYTES + len(name.encode()) + 4
            room = -header % ALIGNMENT_BYTES
            about.extra = PADDING + room.to_bytes(2, "little") + bytes(room)
            packed.writestr(about, data)
    return held.getvalue()


Z = np.array([0.0, 0.0, 1.0])


def write_mesh(path: Path, mesh: Mesh, up: Float[np.ndarray, " 3"] = Z) -> None:
    """Write in the format that the ending names, whole or not at all.

    .ply and .obj, which have no convention for up, are in the frame of the mesh. The other two are
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
