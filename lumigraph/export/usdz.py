"""USDZ: an archive of one mesh and its pictures, for augmented reality on phones and tablets.

Viewers draw no vertex colours, so a mesh without a texture has its colours in a picture: two by two texels for each
triangle, between whose centres a GPU interpolates as between vertices. No library of USD is needed: without usd-core
the layer in the archive is text.
"""

import io
import tempfile
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from string import Template

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

from ..color.tags import srgb_bytes
from ..datasets.mesh import Mesh
from ..exchange.codes import morton_order

ALIGNMENT_BYTES = 64  # of every file's data in the archive (Usdz File Format Specification 1.3, "Layout")
ZIP_HEADER_BYTES = 30  # bytes of a zip file's header before the name
PADDING = b"\x19\x86"  # id of an extra field, which readers ignore
COLOURS, NORMALS = "colours", "normals"  # pictures in the archive
# Light of its own and no other: the light of the scene is in its colours already. Phones take emission for sRGB.
UNLIT = """color3f inputs:diffuseColor = (0, 0, 0)
            color3f inputs:emissiveColor.connect = </Scene/Material/colours.outputs:rgb>"""
LIT = "color3f inputs:diffuseColor.connect = </Scene/Material/colours.outputs:rgb>"
BUMPY = "\n            normal3f inputs:normal.connect = </Scene/Material/normals.outputs:rgb>"
SIGNED = "\n            float4 inputs:scale = (2, 2, 2, 2)\n            float4 inputs:bias = (-1, -1, -1, -1)"

SHADER = Template("""
        def Shader "$name"
        {
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @$name.png@
            token inputs:sourceColorSpace = "$space"
            float2 inputs:st.connect = </Scene/Material/Places.outputs:result>
            token inputs:wrapS = "clamp"
            token inputs:wrapT = "clamp"$scale
            float3 outputs:rgb
        }
""")
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
        normal3f[] normals = [$normals] (
            interpolation = "vertex"
        )
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
            $surface
            float inputs:metallic = 0
            float inputs:roughness = 1
            token outputs:surface
        }

$pictures
        def Shader "Places"
        {
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }
    }
}
""")


def usdz(mesh: Mesh, normals: Float[np.ndarray, "vertex 3"], upright: Float[np.ndarray, "3 3"], lit: bool) -> bytes:
    """A USDZ archive of one mesh, y up, the middle of its base at the origin, a unit of the mesh for a metre.

    upright: the rotation that brings up, in the mesh's frame, to +y
    lit:     whether the lights of a viewer act on it
    """
    turned = mesh.vertices @ upright.T
    low, high = turned.min(0), turned.max(0)
    base = np.array([0.5 * (low[0] + high[0]), low[1], 0.5 * (low[2] + high[2])])
    source_from_upright = np.eye(4)
    source_from_upright[:3, :3], source_from_upright[:3, 3] = upright.T, upright.T @ base
    if mesh.texture is None:
        picture, places = baked(mesh)
        detail = None
    else:
        picture, detail = mesh.texture.colours, mesh.texture.normals if lit else None
        places = (mesh.texture.uv * [1, -1] + [0, 1])[mesh.faces]
    pictures = {COLOURS: picture} | ({} if detail is None else {NORMALS: detail})
    shaders = SHADER.substitute(name=COLOURS, space="sRGB", scale="")
    shaders += "" if detail is None else SHADER.substitute(name=NORMALS, space="raw", scale=SIGNED)
    layer = LAYER.substitute(
        source=f"({tuples(source_from_upright.T, '%.17g')})",  # USD multiplies rows from the left
        extent=tuples(np.stack([low, high]) - base),
        counts=", ".join(["3"] * len(mesh.faces)),
        corners=", ".join(map(str, mesh.faces.reshape(-1).tolist())),
        points=tuples(turned - base),
        normals=tuples(normals @ upright.T, "%.4g"),
        places=tuples(places.reshape(-1, 2), "%.6g"),
        surface=(LIT + ("" if detail is None else BUMPY)) if lit else UNLIT,
        pictures=shaders.strip("\n"),
    )
    parts = {f"{name}.png": png(x, name == COLOURS) for name, x in pictures.items()}
    return archive(binary(layer) | parts)


def binary(layer: str) -> dict[str, bytes]:
    """The root of an archive by its name: a layer in binary, which is smaller; its text without usd-core."""
    try:
        from pxr import Sdf
    except ImportError:
        return {"scene.usda": layer.encode()}
    made = Sdf.Layer.CreateAnonymous(".usda")
    made.ImportFromString(layer)
    with tempfile.TemporaryDirectory() as folder:
        made.Export(str(file := Path(folder) / "scene.usdc"))
        return {file.name: file.read_bytes()}


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


def png(picture: UInt8[np.ndarray, "height width 3"], colours: bool = True) -> bytes:
    """A PNG, with the tag of sRGB for colours."""
    image = Image.fromarray(picture)
    if colours:
        return srgb_bytes(image)
    image.save(held := io.BytesIO(), "PNG")
    return held.getvalue()
