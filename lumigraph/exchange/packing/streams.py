"""Streams: arrays of some dtypes, compressed with zstandard, and unpacked to the declared size at most."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal, cast, get_args

import numpy as np
import zstandard
from jaxtyping import Shaped

from ...files.ranges import Tally, between

ZSTD_LEVEL = 19  # of zstandard: 3 takes a tenth of the time and gives 5 % more
QUICK_LEVEL = 3  # of zstandard, that tells whether differences are smaller
MAX_ZSTD_RATIO = 1 << 15  # times that zstandard can shrink what it is given
CHUNK_BYTES = 1 << 24  # bytes

Extent = Annotated[int, between(0, 1 << 32)]  # of a tensor along an axis
Number = Literal["bool", "uint8", "uint16", "int32", "int64", "float16", "float32", "float64"]


@dataclass(frozen=True)
class Stream:
    """An array within a file.

    bytes: compressed size
    delta: whether rows are stored as differences to the previous one; for integers only
    """

    dtype: Number
    shape: tuple[Extent, ...]
    bytes: Tally
    delta: bool = False

    @property
    def size(self) -> int:
        """Declared bytes of the array before compression."""
        count = math.prod(self.shape)
        return -(-count // 8) if self.dtype == "bool" else count * np.dtype(self.dtype).itemsize


def packed(array: Shaped[np.ndarray, "*shape"]) -> tuple[Stream, bytes]:
    """An array as a stream, with or without delta coding, the smaller of both."""
    ways = (False, True) if array.dtype.kind in "ui" and array.ndim else (False,)
    quick, coder = (zstandard.ZstdCompressor(level=level) for level in (QUICK_LEVEL, ZSTD_LEVEL))
    found = []
    for delta in ways:
        values = np.diff(array, axis=0, prepend=np.zeros_like(array[:1])) if delta else array
        found.append((delta, _bytes(values)))
    delta, raw = min(found, key=lambda pair: len(quick.compress(pair[1]))) if len(found) > 1 else found[0]
    data = coder.compress(raw)
    return Stream(kind_of(array), array.shape, len(data), delta), data


def kind_of(array: Shaped[np.ndarray, "*shape"]) -> Number:
    """Name of an array's dtype, one of those allowed in files."""
    assert array.dtype.name in get_args(Number)
    return cast(Number, array.dtype.name)


def unpacked(stream: Stream, data: bytes) -> Shaped[np.ndarray, "*shape"]:
    """The inverse. Raises ValueError, EOFError or ZstdError for data that contradicts the stream's declaration."""
    if stream.size > MAX_ZSTD_RATIO * max(len(data), 1):
        raise ValueError(f"{len(data)} bytes cannot hold {stream.size:,}")
    reader = zstandard.ZstdDecompressor().stream_reader(data)
    raw = take(reader, stream.size)
    if reader.read(1):
        raise ValueError("a stream goes on after what it declares")
    array = _array(raw, stream.dtype, stream.shape)
    if not stream.delta:
        return array
    if array.dtype.kind not in "ui" or not array.ndim:
        raise ValueError(f"differences of {stream.dtype} mean nothing")
    return np.cumsum(array, 0, dtype=array.dtype)


def take(stream: Any, size: int) -> bytes:
    """Decompress exactly `size` bytes, in pieces, so that memory grows with the data and not with the declared size."""
    pieces = []
    while size:
        piece = stream.read(min(size, CHUNK_BYTES))
        if not piece:
            raise EOFError("it ends early")
        pieces.append(piece)
        size -= len(piece)
    return b"".join(pieces)


def _bytes(array: Shaped[np.ndarray, "*shape"]) -> bytes:
    """Byte shuffle: column by column, first bytes of all numbers, then second ones, which compresses better."""
    if array.dtype == bool:
        return np.packbits(array).tobytes()
    columns = np.ascontiguousarray(array.reshape(array.shape[0] if array.ndim else 1, -1).T) if array.size else array
    return np.ascontiguousarray(columns.reshape(-1, 1).view(np.uint8).T).tobytes()


def _array(raw: bytes, dtype: str, shape: tuple[int, ...]) -> Shaped[np.ndarray, "*shape"]:
    found = np.frombuffer(raw, np.uint8)
    if dtype == "bool":
        return np.unpackbits(found, count=math.prod(shape)).astype(bool).reshape(shape)
    numbers = np.ascontiguousarray(found.reshape(np.dtype(dtype).itemsize, -1).T).view(dtype)[:, 0]
    rows = shape[0] if shape else 1
    return np.ascontiguousarray(numbers.reshape(-1, rows).T).reshape(shape) if numbers.size else numbers.reshape(shape)
