"""glTF of other programs as one plain .glb: linked files inside, packed meshes unpacked, colours of vertices encoded.

Packed by KHR_draco_mesh_compression, EXT_meshopt_compression or KHR_meshopt_compression, and pictures of KTX2: their
decoders are packages of the extra `gltf`.
"""

import importlib
import io
import json
import warnings
from base64 import b64decode
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import msgspec
import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

from ..color.srgb import linear_from_srgb, srgb_from_linear
from ..errors import LumigraphError, LumigraphWarning
from ..files import from_json
from ..files.ranges import Tally, typed
from ..files.reading import reading
from .gltf import BINARY, CHUNK, HEADER, JSON, KINDS, MAGIC, NUMBERS, BaseColour, File, Index, Primitive, TextureLink

MESHOPT, DRACO = ("EXT_meshopt_compression", "KHR_meshopt_compression"), "KHR_draco_mesh_compression"
TRANSFORM, SPECULAR = "KHR_texture_transform", "KHR_materials_pbrSpecularGlossiness"
READ = ("KHR_mesh_quantization", *MESHOPT, DRACO, TRANSFORM, "KHR_texture_basisu", "EXT_texture_webp", "KHR_materials")
KTX2 = b"\xabKTX 20\xbb\r\n\x1a\n"
FAN = 6  # a mode of triangles


class PackedView(msgspec.Struct, rename="camel"):
    """A part of a buffer that meshopt packed."""

    buffer: Index
    byte_length: Tally
    byte_stride: Tally
    count: Tally
    mode: str
    byte_offset: Tally = 0
    filter: str = "NONE"


class PackedPrimitive(msgspec.Struct, rename="camel"):
    """A primitive that Draco packed. attributes: Draco's number of each"""

    buffer_view: Index
    attributes: dict[str, Index]


def unpacked(path: Path) -> tuple[dict[str, Any], bytearray]:
    """JSON and buffer of a .glb or .gltf, without compression and without links to other files.

    Raises LumigraphError for a linked file that is missing, and for compression whose decoder is not installed.
    """
    data, binary, text = path.read_bytes(), b"", b""
    if data[:4] == MAGIC:
        size = CHUNK.unpack_from(data, HEADER.size)[0]
        text, binary = data[HEADER.size + CHUNK.size :][:size], data[HEADER.size + 2 * CHUNK.size + size :]
    about, whole, starts = from_json(text or data, path), bytearray(), []
    others = sorted(x for x in about.get("extensionsRequired", []) if not x.startswith(READ))
    if others:
        warnings.warn(f"{path} needs {', '.join(others)}, which is passed over", LumigraphWarning, 3)
    for buffer in about.get("buffers", []):
        starts.append(len(whole))
        fallback = any(isinstance(x, dict) and x.get("fallback") for x in buffer.get("extensions", {}).values())
        whole += b"" if fallback else linked(path, buffer["uri"]) if "uri" in buffer else binary
        whole += bytes(-len(whole) % 4)
    views = about.setdefault("bufferViews", [])
    for i, view in enumerate(views):
        at = view.get("byteOffset", 0) + starts[view.get("buffer", 0)]
        views[i] = view | {"byteOffset": at, "buffer": 0}
        if packing := next((view["extensions"][x] for x in MESHOPT if x in view.get("extensions", {})), None):
            views[i] = meshopt_view(path, typed(PackedView, packing, path), whole, starts)
    for primitive in primitives(about):
        if packing := primitive.get("extensions", {}).pop(DRACO, None):
            unpack_draco(path, about, primitive, typed(PackedPrimitive, packing, path), whole)
    for image in about.get("images", []):
        uri = image.pop("uri", None)
        if uri is not None and (uri.startswith("data:") or (path.parent / unquote(uri)).is_file()):
            image["bufferView"] = part(about, whole, linked(path, uri))
    nodes = about.get("nodes", [])
    if nodes and not about.get("scenes"):  # which a file may leave out
        inner = {child for node in nodes for child in node.get("children", [])}
        about["scenes"] = [{"nodes": [i for i in range(len(nodes)) if i not in inner]}]
    about.setdefault("scene", 0)
    for texture in about.get("textures", []):
        sources = (x["source"] for x in texture.get("extensions", {}).values() if "source" in x)
        texture |= {"source": texture.get("source", next(sources, None))}
    for material in about.get("materials", []):
        if old := material.get("extensions", {}).get(SPECULAR):
            names = {"baseColorFactor": "diffuseFactor", "baseColorTexture": "diffuseTexture"}
            material["pbrMetallicRoughness"] = {name: old[was] for name, was in names.items() if was in old}
    about["buffers"] = [{"byteLength": len(whole)}] if whole else []
    return about, whole


def primitives(about: dict[str, Any]) -> list[dict[str, Any]]:
    return [primitive for mesh in about.get("meshes", []) for primitive in mesh.get("primitives", [])]


def decoder(path: Path, extension: str, library: str) -> Any:
    """Module that decodes an extension. Raises LumigraphError where it is not installed."""
    try:
        return importlib.import_module(library)
    except ImportError as fault:
        raise LumigraphError(
            f"{path} is packed by {extension}, which {library} reads; install it: pip install 'lumigraph[gltf]', or "
            "export the file without compression"
        ) from fault


def meshopt_view(path: Path, packing: PackedView, whole: bytearray, starts: list[int]) -> dict[str, Any]:
    """Buffer view of the numbers in a packed part, which are appended to the buffer."""
    library, start = decoder(path, MESHOPT[0], "meshopt"), starts[packing.buffer] + packing.byte_offset
    data = bytes(whole[start : start + packing.byte_length])
    with reading(path, f"is damaged where {MESHOPT[0]} packs it", "export it again"):
        found = library.decode_gltf_buffer(data, packing.count, packing.byte_stride, packing.mode, packing.filter)
    view = {"buffer": 0, "byteOffset": len(whole), "byteLength": found.nbytes}
    whole += found.tobytes() + bytes(-found.nbytes % 4)
    return view | ({"byteStride": packing.byte_stride} if packing.mode == "ATTRIBUTES" else {})


def unpack_draco(
    path: Path, about: dict[str, Any], primitive: dict[str, Any], packing: PackedPrimitive, whole: bytearray
) -> None:
    """Give a primitive the accessors of what Draco packed."""
    view = about["bufferViews"][packing.buffer_view]
    data = bytes(whole[view["byteOffset"] : view["byteOffset"] + view["byteLength"]])
    library = decoder(path, DRACO, "DracoPy")
    with reading(path, f"is damaged where {DRACO} packs it", "export it again"):
        found = library.decode(data)
        columns = {name: found.get_attribute_by_unique_id(i)["data"] for name, i in packing.attributes.items()}
        indices = np.asarray(found.faces).astype("<u4").reshape(-1, 1)
    for name, rows in columns.items():
        accessor = about["accessors"][primitive["attributes"][name]]
        values = rows.reshape(len(rows), -1).astype(KINDS[accessor["componentType"]])
        primitive["attributes"][name] = appended(
            about, whole, values, accessor["type"], accessor.get("normalized", False)
        )
    primitive |= {"mode": 4, "indices": appended(about, whole, indices, "SCALAR")}


def plain(path: Path) -> bytes:
    """A .glb or .gltf as one .glb whose positions are floats, whose faces are lists of triangles and whose colours are
    bytes of vertices, sRGB-encoded, for a reader that knows none of the others. Raises LumigraphError as `unpacked`.
    """
    about, whole = unpacked(path)
    file = File(path, packed(about, whole))
    for primitive in primitives(about):
        place = primitive.get("attributes", {}).get("POSITION")
        if place is None:
            continue
        count, read = file.accessor(place).count, typed(Primitive, primitive, path)
        attributes = {"POSITION": appended(about, whole, file.numbers(place, (3,)), "VEC3")}
        if primitive.pop("material", None) is not None or "COLOR_0" in primitive["attributes"]:
            colours = base_colours(file, read, np.arange(count)[:, None], np.ones((1, 1)))
            colours = np.pad(colours, ((0, 0), (0, 1)), constant_values=255)
            attributes["COLOR_0"] = appended(about, whole, colours, "VEC4", True)
        primitive["attributes"] = attributes
        if primitive.get("mode") == FAN:
            own = primitive.get("indices")
            order = np.arange(count) if own is None else file.numbers(own, (1,))[:, 0].astype(np.int64)
            fan = np.stack([np.full(len(order) - 2, order[0]), order[1:-1], order[2:]], 1).astype("<u4").reshape(-1, 1)
            primitive |= {"mode": 4, "indices": appended(about, whole, fan, "SCALAR")}
    for unused in ("materials", "textures", "images"):
        about.pop(unused, None)
    about["buffers"] = [{"byteLength": len(whole)}] if whole else []
    return packed(about, whole)


def base_colours(
    file: File, primitive: Primitive, corners: Int[np.ndarray, "row corner"], spots: Float[np.ndarray, "spot corner"]
) -> UInt8[np.ndarray, "row 3"]:
    """sRGB-encoded base colours: a material's factor times its texture times colours of vertices, in linear light.

    spots: weights of the corners, of the places over whose colours each row takes the mean
    """
    base, light = BaseColour(), np.ones((1, 1, 3))
    if primitive.material is not None:
        base = file.one(file.about.materials, primitive.material, "material").pbr_metallic_roughness
    if "COLOR_0" in primitive.attributes:
        own = file.numbers(primitive.attributes["COLOR_0"], (3, 4))[:, :3].astype(float)
        light = np.einsum("sc,rcu->rsu", spots, own[corners])
    link = base.base_color_texture
    if link is not None and link.index not in file.pixels:
        file.pixels[link.index] = pixels(file, link)
    picture = None if link is None else file.pixels[link.index]
    name = "" if link is None else f"TEXCOORD_{link.extensions.get(TRANSFORM, {}).get('texCoord', link.tex_coord)}"
    if picture is not None and link is not None and name in primitive.attributes:
        uv = np.einsum("sc,rcu->rsu", spots, file.numbers(primitive.attributes[name], (2,))[corners])
        uv = placed(uv, link)
        uv = np.where((uv < 0) | (uv > 1), uv % 1.0, uv)
        height, width = picture.shape[:2]
        column, row = (uv * [width, height]).astype(int).clip(0, [width - 1, height - 1]).transpose(2, 0, 1)
        light = light * linear_from_srgb(np.arange(256) / 255)[picture[row, column]]
    encoded = srgb_from_linear((light * base.base_color_factor[:3]).clip(0, 1)).mean(1)
    return np.broadcast_to(encoded * 255, (len(corners), 3)).round().clip(0, 255).astype(np.uint8)


def placed(uv: Float[np.ndarray, "row spot 2"], link: TextureLink) -> Float[np.ndarray, "row spot 2"]:
    """Texture coordinates after KHR_texture_transform."""
    said = link.extensions.get(TRANSFORM, {})
    cosine, sine = np.cos(said.get("rotation", 0.0)), np.sin(said.get("rotation", 0.0))
    turn = np.array([[cosine, sine], [-sine, cosine]])
    return uv * said.get("scale", [1.0, 1.0]) @ turn.T + said.get("offset", [0.0, 0.0])


def pixels(file: File, link: TextureLink) -> UInt8[np.ndarray, "height width 3"] | None:
    """Pixels of a texture; None, with a warning, if they cannot be read."""
    try:
        data = file.picture(file.one(file.about.textures, link.index, "texture").source or 0)
        if data.startswith(KTX2):
            return decoder(file.path, "KHR_texture_basisu", "opengl_basisu").open(data).transcode("rgba8").data[..., :3]
        with Image.open(io.BytesIO(data)) as image:
            return np.asarray(image.convert("RGB"))
    except Exception as fault:  # a missing texture must not prevent reading the shape
        told = f"{file.path} is read without its texture, which cannot be read ({fault}); its material's colour is used"
        warnings.warn(told, LumigraphWarning, 3)
        return None


def linked(path: Path, uri: str) -> bytes:
    """Bytes in the text itself, or in a file beside it."""
    if uri.startswith("data:"):
        return b64decode(uri.partition(",")[2])
    file = path.parent / unquote(uri)
    if not file.is_file():
        raise LumigraphError(f"{path} keeps its numbers in {file}, which does not exist; copy it too, or export a .glb")
    return file.read_bytes()


def part(about: dict[str, Any], whole: bytearray, data: bytes) -> int:
    """Number of a buffer view of bytes that are appended to the buffer."""
    about["bufferViews"].append({"buffer": 0, "byteOffset": len(whole), "byteLength": len(data)})
    whole += data + bytes(-len(data) % 4)
    return len(about["bufferViews"]) - 1


def appended(about: dict[str, Any], whole: bytearray, values: np.ndarray, shape: str, normalised: bool = False) -> int:
    """Number of an accessor of values that are appended to the buffer."""
    kind, view = NUMBERS[values.dtype], part(about, whole, values.tobytes())
    accessor = {"bufferView": view, "componentType": kind, "count": len(values), "type": shape}
    about["accessors"].append(accessor | ({"normalized": True} if normalised else {}))
    return len(about["accessors"]) - 1


def packed(about: dict[str, Any], buffer: bytes | bytearray) -> bytes:
    """Bytes of a .glb file."""
    text = json.dumps(about).encode()
    text, buffer = text + b" " * (-len(text) % 4), buffer + bytes(-len(buffer) % 4)
    chunks = CHUNK.pack(len(text), JSON) + text + (CHUNK.pack(len(buffer), BINARY) + buffer if buffer else b"")
    return HEADER.pack(MAGIC, 2, HEADER.size + len(chunks)) + chunks
