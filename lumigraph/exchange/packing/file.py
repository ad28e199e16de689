"""One file of compressed tensors: a header that declares all sizes, then streams compressed by zstandard.

    8 bytes "LUMIPACK" · 4 bytes length of the head · the head, JSON (`Head`) · one stream after another

Declared sizes are compared with the file's bytes and with free memory before anything is unpacked. Equal streams are
stored once, so that tensors share a mask of kept rows.
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Shaped
from torch import Tensor

from ...errors import LumigraphError
from ...files import from_json
from ...files.ranges import Coordinate, Name, between, typed
from ...files.reading import reading
from ...system.memory import free_memory, gigabytes
from .forms import FORMS
from .streams import Extent, Number, Stream, kind_of, unpacked
from .streams import packed as to_stream
from .table import Layout, Table

MAGIC = b"LUMIPACK"
HEAD = struct.Struct("<8sI")  # magic, length of the head
UNPACKING_FACTOR = 3  # times the bytes of all tensors that unpacking needs

Which = Annotated[int, between(0, 1_000_000)]  # stream


@dataclass(frozen=True)
class PackedPart:
    """Columns in one form, and their streams."""

    form: str
    streams: tuple[Which, ...]


@dataclass(frozen=True)
class Entry:
    """A tensor: a `Table`, or a lossless stream.

    kept: stream with the mask of rows that are not `fill`
    """

    shape: tuple[Extent, ...]
    dtype: Number
    exact: Which | None = None
    layout: Layout = "rows"
    fill: Coordinate = 0.0
    kept: Which | None = None
    parts: tuple[PackedPart, ...] = ()


@dataclass(frozen=True)
class Head:
    streams: tuple[Stream, ...]
    tensors: dict[Name, Entry] = field(default_factory=dict)


class Streams:
    """Streams of a file in writing, without duplicates."""

    def __init__(self) -> None:
        self.about: list[Stream] = []
        self.data: list[bytes] = []

    def add(self, array: Shaped[np.ndarray, "*shape"]) -> int:
        """Add a stream unless it exists. Returns its index."""
        stream, data = to_stream(array)
        for number, (other, known) in enumerate(zip(self.about, self.data, strict=True)):
            if (stream, data) == (other, known):
                return number
        self.about.append(stream)
        self.data.append(data)
        return len(self.data) - 1


def write(tensors: dict[str, Tensor | Table]) -> bytes:
    """The file's bytes. Tables are stored in their forms, tensors losslessly."""
    streams, entries = Streams(), dict[str, Entry]()
    for name, value in tensors.items():
        if isinstance(value, Tensor):
            array = value.detach().cpu().numpy()
            entries[name] = Entry(array.shape, kind_of(array), streams.add(array))
            continue
        kept = None if value.kept is None else streams.add(value.kept.numpy())
        parts = tuple(PackedPart(form.name, tuple(map(streams.add, form.streams()))) for form in value.forms)
        entries[name] = Entry(value.shape, value.dtype, None, value.layout, value.fill, kept, parts)
    head = json.dumps(asdict(Head(tuple(streams.about), entries)), separators=(",", ":")).encode()
    return b"".join([HEAD.pack(MAGIC, len(head)), head, *streams.data])


def read(data: bytes, path: Path) -> dict[str, Tensor]:
    """Read the tensors. path: named in the LumigraphError for a damaged file or one that declares too much"""
    magic, length = HEAD.unpack(data[: HEAD.size]) if len(data) >= HEAD.size else (b"", 0)
    if magic != MAGIC or HEAD.size + length > len(data):
        raise LumigraphError(f"{path} holds no packed tensors; restore it from a copy")
    head = typed(Head, from_json(data[HEAD.size : HEAD.size + length], path), path)
    check_sizes(head, len(data) - HEAD.size - length, path)
    with reading(path, "does not hold the tensors that it declares", "restore a copy"):
        at, arrays = HEAD.size + length, list[np.ndarray]()
        for stream in head.streams:
            arrays.append(unpacked(stream, data[at : at + stream.bytes]))
            at += stream.bytes
        return {name: tensor_of(entry, arrays) for name, entry in head.tensors.items()}


def check_sizes(head: Head, there: int, path: Path) -> None:
    """Raise LumigraphError for missing streams, and for tensors that exceed memory."""
    if (declared := sum(stream.bytes for stream in head.streams)) != there:
        raise LumigraphError(
            f"{path} declares {declared:,} bytes of tensors and holds {there:,}; restore it from a copy"
        )
    sizes = [math.prod(entry.shape) * np.dtype(entry.dtype).itemsize for entry in head.tensors.values()]
    needed, free = UNPACKING_FACTOR * (sum(sizes) + sum(stream.size for stream in head.streams)), free_memory()
    if needed > free:
        raise LumigraphError(
            f"{path} declares tensors that take {gigabytes(needed)} to unpack, and {gigabytes(free)} are free; "
            "restore it from a copy, or take a larger machine"
        )


def tensor_of(entry: Entry, arrays: list[np.ndarray]) -> Tensor:
    """A tensor from its streams. Raises ValueError and similar errors for inconsistent ones."""
    if entry.exact is not None:
        return torch.from_numpy(arrays[entry.exact].copy()).reshape(entry.shape)
    kept = None if entry.kept is None else torch.from_numpy(arrays[entry.kept])
    if kept is not None and (kept.dtype != torch.bool or kept.dim() != 1):
        raise ValueError("a mask marks no rows")
    forms = []
    for part in entry.parts:
        kind, count = FORMS[part.form]
        if len(part.streams) != count:
            raise ValueError(f"{part.form} takes {count} streams")
        forms.append(kind.read([arrays[i] for i in part.streams]))
    table = Table(entry.shape, entry.layout, entry.fill, kept, forms, entry.dtype)
    return table.tensor()
