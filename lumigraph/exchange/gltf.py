"""Binary glTF 2.0: JSON and one buffer of numbers, in one .glb file.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html. Sizes in the JSON are compared with the
bytes of the file before any number is read.
"""

from __future__ import annotations

import json
import struct
import warnings
from base64 import b64decode
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import unquote

import msgspec
import numpy as np

from ..errors import LumigraphError, LumigraphWarning
from ..files import from_json
from ..files.ranges import Coordinate, Tally, between, format_value, typed
from ..files.reading import reading

HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
MAGIC, JSON, BINARY = b"glTF", b"JSON", b"BIN\0"
PACKINGS = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")  # of vertices
KTX2 = "KHR_texture_basisu"
MAX_JSON_BYTES = 1 << 24
FAN = 6  # a mode of triangles
VERTICES, INDICES = 34962, 34963  # section 5.11.5: what a part of the buffer is for
KINDS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}  # 3.6.2.2
NUMBERS = {np.dtype(kind): number for number, kind in KINDS.items()}
SHAPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
NAMES = {width: name for name, width in SHAPES.items()}

Index = Annotated[int, between(0, 1 << 32)]
Matrix = tuple[Coordinate, ...]  # of 16, column after column


class BufferView(msgspec.Struct, rename="camel"):
    """A part of the buffer."""

    buffer: Index
    byte_length: Tally
    byte_offset: Tally = 0
    byte_stride: Annotated[int, between(0, 252)] = 0


class Accessor(msgspec.Struct, rename="camel"):
    """Numbers in a part of the buffer."""

    component_type: int
    count: Tally
    type: str
    buffer_view: Index | None = None
    byte_offset: Tally = 0
    normalized: bool = False
    sparse: Any = None


class SparsePart(msgspec.Struct, rename="camel"):
    """Indices of changed rows, or their values (section 3.6.2.3)."""

    buffer_view: Index
    byte_offset: Tally = 0
    component_type: int = 5126


class Sparse(msgspec.Struct):
    """Rows of an accessor that differ from its buffer view, or from zero."""

    indices: SparsePart
    values: SparsePart
    count: Tally


class Buffer(msgspec.Struct, rename="camel"):
    byte_length: Tally
    uri: Any = None


class Primitive(msgspec.Struct, rename="camel"):
    attributes: dict[str, Index]
    indices: Index | None = None
    material: Index | None = None
    mode: int = 4
    extensions: dict[str, Any] = {}
    extras: Any = None


class GltfMesh(msgspec.Struct, rename="camel"):
    primitives: list[Primitive]


class Node(msgspec.Struct, rename="camel"):
    """A node's transform: a matrix, or a scale, a rotation (x, y, z, w) and a translation, in this order."""

    name: str = ""
    mesh: Index | None = None
    skin: Index | None = None
    children: list[Index] = []
    matrix: Matrix | None = None
    rotation: tuple[Coordinate, ...] = (0.0, 0.0, 0.0, 1.0)
    scale: tuple[Coordinate, ...] = (1.0, 1.0, 1.0)
    translation: tuple[Coordinate, ...] = (0.0, 0.0, 0.0)


class Skin(msgspec.Struct, rename="camel"):
    """Joints that move a mesh (section 3.7.3)."""

    joints: list[Index]
    inverse_bind_matrices: Index | None = None


class Target(msgspec.Struct, rename="camel"):
    """Target of a channel: a node and its property."""

    path: str
    node: Index | None = None


class Channel(msgspec.Struct, rename="camel"):
    sampler: Index
    target: Target


class KeyframeSampler(msgspec.Struct, rename="camel"):
    """Keyframes: accessors of their times and of their values."""

    input: Index
    output: Index
    interpolation: str = "LINEAR"


class Animation(msgspec.Struct, rename="camel"):
    """Motion of nodes (section 3.11)."""

    channels: list[Channel]
    samplers: list[KeyframeSampler]
    name: str = ""


class TextureLink(msgspec.Struct, rename="camel", frozen=True):
    index: Index
    tex_coord: Index = 0


class BaseColour(msgspec.Struct, rename="camel", frozen=True):
    """Colour of a material: linear, times a texture's."""

    base_color_factor: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
    base_color_texture: TextureLink | None = None


class GltfMaterial(msgspec.Struct, rename="camel"):
    pbr_metallic_roughness: BaseColour = BaseColour()


class GltfTexture(msgspec.Struct, rename="camel"):
    source: Index | None = None


class GltfImage(msgspec.Struct, rename="camel"):
    buffer_view: Index | None = None


class GltfScene(msgspec.Struct, rename="camel"):
    nodes: list[Index] = []


class About(msgspec.Struct, rename="camel"):
    """The used parts of the JSON chunk."""

    accessors: list[Accessor] = []
    buffer_views: list[BufferView] = []
    buffers: list[Buffer] = []
    meshes: list[GltfMesh] = []
    nodes: list[Node] = []
    skins: list[Skin] = []
    animations: list[Animation] = []
    materials: list[GltfMaterial] = []
    textures: list[GltfTexture] = []
    images: list[GltfImage] = []
    scenes: list[GltfScene] = []
    scene: Index = 0
    extensions_used: list[str] = []
    extensions_required: list[str] = []


@dataclass(frozen=True)
class Column:
    """Array to write, [row] or [row, component].

    normalised: whether integers represent [0, 1] or [-1, 1]
    bounded:    whether to write minimum and maximum, as positions need
    """

    numbers: np.ndarray
    normalised: bool = False
    bounded: bool = False
    target: int = VERTICES


def encoded(about: dict[str, Any], columns: list[Column], pictures: Sequence[tuple[str, bytes]] = ()) -> bytes:
    """A .glb file: `about`, an accessor for each column and an image for each picture, in their order, aligned to 4
                 bytes.

    pictures: media type and file of each
    """
    parts = [np.ascontiguousarray(column.numbers).tobytes() for column in columns]
    parts += [data for _, data in pictures]
    starts = np.cumsum([0, *(len(part) + -len(part) % 4 for part in parts)]).tolist()
    views: list[dict[str, Any]] = [
        {"buffer": 0, "byteOffset": start, "byteLength": len(part)} for start, part in zip(starts, parts, strict=False)
    ]
    for view, column in zip(views, columns, strict=False):
        view["target"] = column.target
    accessors = [_accessor(i, column) for i, column in enumerate(columns)]
    whole = about | {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": starts[-1]}]}
    if pictures:
        whole["images"] = [{"bufferView": len(columns) + i, "mimeType": kind} for i, (kind, _) in enumerate(pictures)]
    text = json.dumps(whole, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    body = CHUNK.pack(len(text), JSON) + text + CHUNK.pack(starts[-1], BINARY)
    body += b"".join(part + bytes(-len(part) % 4) for part in parts)
    return HEADER.pack(MAGIC, 2, HEADER.size + len(body)) + body


def _accessor(view: int, column: Column) -> dict[str, Any]:
    numbers = column.numbers
    shape = NAMES[numbers.shape[1] if numbers.ndim > 1 else 1]
    fields = {"bufferView": view, "componentType": NUMBERS[numbers.dtype], "type": shape, "count": len(numbers)}
    if column.normalised:
        fields["normalized"] = True
    if column.bounded:
        fields |= {"min": numbers.min(0).tolist(), "max": numbers.max(0).tolist()}
    return fields


def refuse_compressed(path: Path) -> None:
    """Raise LumigraphError for glTF whose meshes are packed by an extension."""
    with open(path, "rb") as file:
        head = file.read(HEADER.size + CHUNK.size)
        length = MAX_JSON_BYTES
        if head[:4] == MAGIC and len(head) == HEADER.size + CHUNK.size:
            length, head = CHUNK.unpack_from(head, HEADER.size)[0], b""
        text = head + file.read(min(length, MAX_JSON_BYTES))
    if found := [name for name in PACKINGS if f'"{name}"'.encode() in text]:
        raise LumigraphError(
            f"{path} is packed by {' and '.join(found)}, which is not read; export it without compression, "
            "for instance from Blender, which opens it"
        )
    if f'"{KTX2}"'.encode() in text:
        told = f"{path} has textures of KTX2, which are not read; colours are those of its materials"
        warnings.warn(told, LumigraphWarning, 3)


def plain(path: Path) -> bytes:
    """A .glb or .gltf as one .glb whose positions are floats and whose faces are lists of triangles, for a reader that
    knows neither sparse nor normalised numbers nor fans. Raises LumigraphError for a file that it leads to and is none.
    """
    data, binary, text = path.read_bytes(), b"", b""
    if data[:4] == MAGIC:
        size = CHUNK.unpack_from(data, HEADER.size)[0]
        text, binary = data[HEADER.size + CHUNK.size :][:size], data[HEADER.size + 2 * CHUNK.size + size :]
    about, whole, starts = from_json(text or data, path), bytearray(), []
    for buffer in about.get("buffers", []):
        starts.append(len(whole))
        whole += binary if buffer.get("uri") is None else linked(path, buffer["uri"])
        whole += bytes(-len(whole) % 4)
    for view in about.get("bufferViews", []):
        view["byteOffset"] = view.get("byteOffset", 0) + starts[view.get("buffer", 0)]
        view["buffer"] = 0
    for image in about.get("images", []):
        image |= {"uri": unquote(image["uri"])} if not image.get("uri", "data:").startswith("data:") else {}
    about["buffers"] = [{"byteLength": len(whole)}] if whole else []
    file, done = File(path, packed(about, bytes(whole))), set()
    for primitive in (x for mesh in about.get("meshes", []) for x in mesh.get("primitives", [])):
        place = primitive.get("attributes", {}).get("POSITION")
        if place is None:
            continue
        accessor = file.accessor(place)
        if place not in done and (accessor.sparse is not None or accessor.component_type != NUMBERS[np.dtype("<f4")]):
            about["accessors"][place] = appended(about, whole, file.numbers(place, (3,)), "VEC3")
            done.add(place)
        if primitive.get("mode") == FAN:
            count, own = accessor.count, primitive.get("indices")
            order = np.arange(count) if own is None else file.numbers(own, (1,))[:, 0].astype(np.int64)
            fan = np.stack([np.full(len(order) - 2, order[0]), order[1:-1], order[2:]], 1).astype("<u4").reshape(-1, 1)
            primitive |= {"mode": 4, "indices": len(about["accessors"])}
            about["accessors"].append(appended(about, whole, fan, "SCALAR"))
    about["buffers"] = [{"byteLength": len(whole)}] if whole else []
    return packed(about, bytes(whole))


def linked(path: Path, uri: str) -> bytes:
    """Bytes of a buffer in the text itself, or in a file beside it."""
    if uri.startswith("data:"):
        return b64decode(uri.partition(",")[2])
    file = path.parent / unquote(uri)
    if not file.is_file():
        raise LumigraphError(f"{path} keeps its numbers in {file}, which does not exist; copy it too, or export a .glb")
    return file.read_bytes()


def appended(about: dict[str, Any], whole: bytearray, values: np.ndarray, shape: str) -> dict[str, Any]:
    """Accessor of values that are appended to the buffer."""
    about["bufferViews"].append({"buffer": 0, "byteOffset": len(whole), "byteLength": values.nbytes})
    whole += values.tobytes()
    kind, view = NUMBERS[values.dtype], len(about["bufferViews"]) - 1
    return {"bufferView": view, "componentType": kind, "count": len(values), "type": shape}


def packed(about: dict[str, Any], buffer: bytes) -> bytes:
    """Bytes of a .glb file."""
    text = json.dumps(about).encode()
    text, buffer = text + b" " * (-len(text) % 4), buffer + bytes(-len(buffer) % 4)
    chunks = CHUNK.pack(len(text), JSON) + text + (CHUNK.pack(len(buffer), BINARY) + buffer if buffer else b"")
    return HEADER.pack(MAGIC, 2, HEADER.size + len(chunks)) + chunks


class File:
    """An opened .glb file: its JSON `about`, and the numbers of its accessors.

    Raises LumigraphError for an invalid or truncated file, and for references to other files.
    """

    about: About

    def __init__(self, path: Path, data: bytes | None = None):
        self.path, data = path, path.read_bytes() if data is None else data
        if len(data) < HEADER.size + CHUNK.size or data[:4] != MAGIC:
            raise LumigraphError(f"{path} is no .glb file, for it does not begin like one; name another one")
        _, version, size = HEADER.unpack_from(data)
        if version != 2:
            raise LumigraphError(f"{path} is glTF of version {version}, of which 2 can be read; export it again")
        if size > len(data):
            raise LumigraphError(f"{path} ends early, for it promises {size:,} bytes; copy or download it again")
        text, after = self._chunk(data, HEADER.size, JSON)
        self.about = typed(About, from_json(text, path), path)
        self.buffer = self._chunk(data, after, BINARY)[0] if after + CHUNK.size <= len(data) else b""

    def _chunk(self, data: bytes, at: int, name: bytes) -> tuple[bytes, int]:
        size, found = CHUNK.unpack_from(data, at)
        start = at + CHUNK.size
        if found != name or start + size > len(data):
            raise LumigraphError(
                f"{self.path} is damaged, for its {name[:4].strip(bytes(1)).decode()} is cut or not where "
                "it should be; copy or download it again"
            )
        return data[start : start + size], start + size

    def accessor(self, index: int) -> Accessor:
        return self.one(self.about.accessors, index, "accessor")

    def one(self, things: list[Any], index: int, what: str) -> Any:
        """Item by index. Raises LumigraphError if there is none."""
        if index >= len(things):
            raise LumigraphError(f"{self.path} names {what} {index}, and has {len(things)}; export it again")
        return things[index]

    def numbers(self, index: int, widths: tuple[int, ...]) -> np.ndarray:
        """Values of an accessor, float32 [row, component]; normalised integers are within [-1, 1].

        widths: allowed numbers of components
        Raises LumigraphError if it is of another shape or kind, or reaches beyond its buffer.
        """
        accessor = self.accessor(index)
        kind, width = KINDS.get(accessor.component_type), SHAPES.get(accessor.type)
        if kind is None or width not in widths or (accessor.sparse is None and accessor.buffer_view is None):
            raise LumigraphError(
                f"{self.path}: accessor {index} is of a kind that is not read here ({format_value(accessor.type)} of "
                f"type {accessor.component_type}, or without numbers); export it without compression"
            )
        dtype = np.dtype(kind)
        found = np.zeros((accessor.count, width), np.float32)
        if accessor.buffer_view is not None:
            place = accessor.buffer_view, accessor.byte_offset, accessor.count
            found = self._stored(index, *place, dtype, width).astype(np.float32)
        if accessor.sparse is not None:
            with reading(self.path, "has a sparse accessor that contradicts itself", "export it again"):
                said = typed(Sparse, accessor.sparse, self.path)
                there, values, kind = said.indices, said.values, KINDS[said.indices.component_type]
                rows = self._stored(index, there.buffer_view, there.byte_offset, said.count, np.dtype(kind), 1)[:, 0]
                changed = self._stored(index, values.buffer_view, values.byte_offset, said.count, dtype, width)
                found[rows] = changed
        if accessor.normalized and dtype.kind in "iu":
            found = np.maximum(found / np.float32(np.iinfo(dtype).max), -1)
        return found

    def _stored(self, index: int, view: int, offset: int, count: int, dtype: np.dtype, width: int) -> np.ndarray:
        """Rows of a part of the buffer. index: of the accessor, for the sentence on a part that is too short"""
        about = self.one(self.about.buffer_views, view, "buffer view")
        buffer = self.one(self.about.buffers, about.buffer, "buffer")
        if about.buffer or buffer.uri is not None:
            raise LumigraphError(f"{self.path} leads to other files for its numbers; export it as one .glb")
        stride = about.byte_stride or dtype.itemsize * width
        end = offset + (stride * (count - 1) + dtype.itemsize * width if count else 0)
        if end > about.byte_length or about.byte_offset + about.byte_length > min(len(self.buffer), buffer.byte_length):
            raise LumigraphError(
                f"{self.path}: accessor {index} promises {count:,} rows, and the buffer of {len(self.buffer):,} bytes "
                "ends before; copy or download it again"
            )
        start = about.byte_offset + offset
        return np.ndarray((count, width), dtype, self.buffer, start, (stride, dtype.itemsize))

    def picture(self, index: int) -> bytes:
        """Bytes of an embedded image. Raises LumigraphError for an external one."""
        image = self.one(self.about.images, index, "image")
        if image.buffer_view is None:
            raise LumigraphError(f"{self.path} leads to other files for its pictures; export it as one .glb")
        view = self.one(self.about.buffer_views, image.buffer_view, "buffer view")
        return self.buffer[view.byte_offset : view.byte_offset + view.byte_length]
