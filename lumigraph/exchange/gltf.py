"""Binary glTF 2.0: JSON and one buffer of numbers, in one .glb file.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html. Sizes in the JSON are compared with the
bytes of the file before any number is read.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from ..errors import LumigraphError
from ..files import from_json
from ..files.ranges import Coordinate, Tally, between, format_value, typed
from ..files.reading import reading

HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
MAGIC, JSON, BINARY = b"glTF", b"JSON", b"BIN\0"
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
    extensions: dict[str, Any] = {}


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


class File:
    """An opened .glb file: its JSON `about`, and the numbers of its accessors. pixels: decoded textures, by number

    Raises LumigraphError for an invalid or truncated file, and for references to other files.
    """

    about: About

    def __init__(self, path: Path, data: bytes | None = None):
        self.path, data = path, path.read_bytes() if data is None else data
        self.pixels: dict[int, np.ndarray | None] = {}
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
