"""One file of tensors in few bytes: a head that declares everything, then streams packed by zstandard.

    8 bytes "LUMIPACK" · 4 bytes length of the head · the head, JSON (`Head`) · one stream after another

Nothing of it is unpacked before its declared sizes were compared with the bytes that are there and with the memory that
is free. Streams that are alike are stored once, so that tensors share a mask of what is kept.
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
    """Columns in one form, and the streams that hold it."""

    form: str
    streams: tuple[Which, ...]


@dataclass(frozen=True)
class Entry:
    """A tensor: a `Table`; or the stream that holds it to the bit.

    kept: the stream that marks rows which are not `fill`
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
    """The streams of a file that is being written: what is there already is not written again."""

    def __init__(self) -> None:
        self.about: list[Stream] = []
        self.data: list[bytes] = []

    def add(self, array: Shaped[np.ndarray, "*shape"]) -> int:
        """Its number."""
        stream, data = to_stream(array)
        for number, (other, known) in enumerate(zip(self.about, self.data, strict=True)):
            if (stream, data) == (other, known):
                return number
        self.about.append(stream)
        self.data.append(data)
        return len(self.data) - 1


def write(tensors: dict[str, Tensor | Table]) -> bytes:
    """The file's bytes. Tables are stored in their forms, tensors to the bit."""
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
    """The tensors. path: named in the LumigraphError for a damaged file or one that declares too much."""
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
    """Raise LumigraphError for streams that are not there, and for tensors that memory would not hold."""
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
    """A tensor of the streams that hold it. Raises ValueError and its like where they do not fit."""
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
