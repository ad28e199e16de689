"""Files made wrong: bytes of any, values of JSON, words of texts, and the headers of formats that have some."""

from __future__ import annotations

import copy
import gzip
import io
import json
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import zstandard

from . import hostile, nasty

EXTREMES = [b"\xff" * 8, b"\0" * 8, b"\xff" * 3 + b"\x7f" + b"\0" * 4, struct.pack("<d", float("nan"))]
EXTREMES += [struct.pack("<Q", n) for n in (2**31, 2**32, 10**9, 10**12, 2**62, 2**63)]
EXTREMES += [struct.pack("<ff", *pair) for pair in ((float("nan"), float("inf")), (1e38, -1e38), (0.0, -1.0))]
COUNTS = [b"0", b"-1", b"1", b"7", b"100000000", b"4294967296", b"99999999999999999999", b"1e9", b"nan", b"x", b""]
FORMATS_WITH_PLY_TYPES = [b"float", b"double", b"uchar", b"int", b"list uchar int", b"list int float", b"half", b""]
BOMB = 1 << 26  # zeros in one piece of a stream

Bend = Callable[[bytes, random.Random], bytes]


def bend(path: Path, chance: random.Random) -> str:
    """Change a file in place. Gives the name of what was done to it."""
    data = path.read_bytes()
    if b"|O" in data[: hostile.HEADER]:
        path.write_bytes(hostile.pickled(data, chance))
        return "pickled"
    ways = [*WAYS.get(path.suffix.lower(), ()), raw]
    way = chance.choices(ways, [3.0] * (len(ways) - 1) + [1.0])[0]
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        try:
            data = way(data, chance)
        except Exception:  # a file that was changed before is none that this way knows
            data = raw(data, chance)
    path.write_bytes(data)
    if path.suffix == ".packed" and (state := path.with_name("state.json")).exists():
        sign(state, path.name, data)
    return way.__name__


def sign(state: Path, name: str, data: bytes) -> None:
    """Let a checkpoint's sum be that of a bent file, as it is where somebody means harm."""
    said = json.loads(state.read_text())
    said["files"][name] = {"bytes": len(data), "crc32": zlib.crc32(data)}
    state.write_text(json.dumps(said))


def raw(data: bytes, chance: random.Random) -> bytes:
    """Bytes, whatever they mean: cut, flipped, repeated, lost, or replaced by extreme numbers."""
    if not data:
        return chance.randbytes(64)
    size, at = len(data), int(len(data) * chance.random() ** 3)  # headers matter more
    some = min(size - at, chance.choice((1, 4, 8, 64, 1000)))
    way = chance.randrange(10)
    if way == 0:
        return data[:at]
    if way == 1:
        return b""
    if way == 2:
        return data[:at] + data[at + some :]
    if way == 3:
        return data[:at] + data[at : at + some] * chance.choice((2, 100)) + data[at + some :]
    if way == 4:
        return data[:at] + chance.randbytes(some) + data[at + some :]
    if way == 5:
        return data + chance.randbytes(chance.choice((1, 7, 5000)))
    if way == 6:
        return chance.randbytes(min(size, 4096))
    if way == 7:
        flipped = bytearray(data)
        for _ in range(chance.choice((1, 3, 30))):
            flipped[int(size * chance.random() ** 2)] ^= 1 << chance.randrange(8)
        return bytes(flipped)
    extreme = chance.choice(EXTREMES)[: chance.choice((1, 2, 4, 8))]
    at -= at % len(extreme)
    return data[:at] + extreme + data[at + len(extreme) :]


def values(data: bytes, chance: random.Random) -> bytes:
    """JSON with one value replaced, lost, doubled, nested or renamed."""
    try:
        return nasty.dumped(bent(json.loads(data), chance))
    except (ValueError, RecursionError):
        return raw(data, chance)


def bent(data: Any, chance: random.Random) -> Any:
    """A copy of plain data that differs in one place, chosen so that shallow ones are as likely as deep ones."""
    if not isinstance(data, dict | list) or not data or chance.random() < 0.06:
        return nasty.value(chance, data)
    keys = list(data) if isinstance(data, dict) else range(len(data))
    key = chance.choice(keys)
    if chance.random() < 0.5:
        result = copy.copy(data)
        result[key] = bent(data[key], chance)
        return result
    result, way = copy.deepcopy(data), chance.randrange(7)
    if way == 0:
        del result[key]
    elif way == 1:
        result[key] = {"a": result[key]} if chance.random() < 0.5 else [result[key]]
    elif way == 2 and isinstance(result, list):
        result.insert(key, copy.deepcopy(result[key]))
    elif way == 3 and isinstance(result, dict):
        result[chance.choice([*nasty.TEXTS, *nasty.PATHS])] = result.pop(key)
    elif way == 4:
        other = chance.choice(keys)
        result[key], result[other] = result[other], result[key]
    elif way == 5 and isinstance(result, dict):
        result[chance.choice(nasty.TEXTS)] = nasty.value(chance)
    else:
        result[key] = nasty.value(chance, result[key])
    return result


def rows(data: bytes, chance: random.Random) -> bytes:
    """Lines of JSON, one of them changed."""
    lines = data.splitlines(keepends=True)
    at = chance.randrange(len(lines) or 1)
    return b"".join([*lines[:at], values(lines[at] if lines else b"{}", chance) + b"\n", *lines[at + 1 :]])


def words(data: bytes, chance: random.Random) -> bytes:
    """A text with a word or a line replaced, lost or doubled."""
    way, parts = chance.randrange(4), re.split(rb"(\s+)", data)
    at = 2 * chance.randrange((len(parts) + 1) // 2)
    if way == 0:
        lines = data.splitlines(keepends=True) or [b""]
        at = chance.randrange(len(lines))
        return b"".join([*lines[:at], *lines[at : at + 1] * chance.choice((0, 2, 50)), *lines[at + 1 :]])
    if way == 1:
        parts[at] = b""
    else:
        word = chance.choice([*map(str, nasty.NUMBERS), *nasty.TEXTS, *nasty.PATHS, "1" * 5000])
        parts[at] = word.encode("utf-8", errors="replace")
    return b"".join(parts)


def png(data: bytes, chance: random.Random) -> bytes:
    """A picture that says it is larger, of other bits or colours than it is; its checksum agrees."""
    size = [chance.choice((0, 1, 3, 30000, 100000, 2**31 - 1, 2**32 - 1)) for _ in range(2)]
    fields = list(struct.unpack(">IIBBBBB", data[16:29])) if len(data) > 33 else [1, 1, 8, 2, 0, 0, 0]
    for at in chance.sample(range(7), chance.choice((1, 1, 2))):
        fields[at] = size[at] if at < 2 else chance.choice((0, 1, 2, 3, 4, 6, 16, 255))
    header = b"IHDR" + struct.pack(">IIBBBBB", *fields)
    return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]


def ply(data: bytes, chance: random.Random) -> bytes:
    """A header that promises something else."""
    head, mark, body = data.partition(b"end_header\n")
    lines, way = head.splitlines(), chance.randrange(5)
    at = chance.randrange(len(lines) or 1)
    if not lines or way == 0:
        return words(head, chance) + mark + body
    if way == 1:
        counted = [i for i, line in enumerate(lines) if line.startswith(b"element")]
        if counted:
            at = chance.choice(counted)
            lines[at] = b" ".join([*lines[at].split()[:2], chance.choice(COUNTS)])
    elif way == 2:
        kind = chance.choice(FORMATS_WITH_PLY_TYPES)
        lines[at] = b"property " + kind + b" " + lines[at].split()[-1] if lines[at].split() else kind
    elif way == 3:
        lines[at : at + 1] = [lines[at]] * chance.choice((0, 2, 300))
    else:
        kinds = (b"ascii", b"binary_little_endian", b"binary_big_endian", b"nonsense")
        lines[1:2] = [b"format " + chance.choice(kinds) + b" 1.0"]
    return b"\n".join(lines) + b"\n" + mark + body


def npy(data: bytes, chance: random.Random) -> bytes:
    """An array of other numbers, of another shape or kind than there is, or that promises what is not there."""
    import numpy as np

    way = chance.randrange(4)
    if way == 0:
        return words(data[:128], chance).ljust(128) + data[128:]
    if way == 1:
        kinds = (b"<f4", b"<i8", b"|S8", b"<c16", b"|O", b"|b1", b"<U4", b"<f2", b">f8", b"|V8", b"<M8", b"|u1")
        return data[:128].replace(b"<f8", chance.choice(kinds)) + data[128:]
    if way == 2:
        shapes = (b"(0, 17)", b"(10,)", b"(100000000000, 17)", b"(-1, 17)", b"()", b"(10, 17, 1)", b"(99999999999999,)")
        head = re.sub(rb"\(\d+, \d+\)", chance.choice(shapes), data[:128])[:127].ljust(127) + b"\n"
        return head + data[128:]
    table = np.load(io.BytesIO(data), allow_pickle=False)
    table.flat[chance.randrange(table.size)] = float(chance.choice([n for n in nasty.NUMBERS if abs(n) < 1e301]))
    kept = io.BytesIO()
    np.save(kept, table)
    return kept.getvalue()


def safetensors(data: bytes, chance: random.Random) -> bytes:
    """Tensors whose header is not what it was."""
    if len(data) < 8:
        return raw(data, chance)
    (length,) = struct.unpack_from("<Q", data)
    header = values(data[8 : 8 + length], chance)
    return struct.pack("<Q", len(header)) + header + data[8 + length :]


def head_and_streams(data: bytes) -> tuple[dict[str, Any], list[bytes]]:
    """Of packed tensors. Raises ValueError and its like where there is no such thing."""
    (length,) = struct.unpack_from("<I", data, 8)
    head, at, streams = json.loads(data[12 : 12 + length]), 12 + length, []
    for stream in head["streams"]:
        streams.append(data[at : at + stream["bytes"]])
        at += stream["bytes"]
    return head, streams


def packed(data: bytes, chance: random.Random) -> bytes:
    """Packed tensors whose head is not what it was, or whose streams hold something else, or are bombs."""
    try:
        head, streams = head_and_streams(data)
        way, at = chance.randrange(4), chance.randrange(len(streams))
        if way == 0:
            head = bent(head, chance)
        elif way == 1:
            key = chance.choice(("streams", "tensors"))
            head[key] = bent(head[key], chance)
        elif way == 2:
            inside = zstandard.ZstdDecompressor().stream_reader(streams[at]).read(1 << 22)
            streams[at] = zstandard.compress(raw(inside, chance))
        else:
            streams[at] = zstandard.compress(bytes(BOMB))
            head["streams"][at]["shape"] = chance.choice(([BOMB], [1 << 40], [1 << 31, 1 << 31], [1 << 32, 64]))
        if way > 1:
            head["streams"][at]["bytes"] = len(streams[at])
        text = nasty.dumped(head)
    except (ValueError, LookupError, TypeError, struct.error, RecursionError, zstandard.ZstdError):
        return raw(data, chance)
    return data[:8] + struct.pack("<I", len(text)) + text + b"".join(streams)


def numbers(data: bytes, chance: random.Random) -> bytes:
    """Tensors some of whose numbers are extreme."""
    if len(data) < 64:
        return raw(data, chance)
    changed, begin = bytearray(data), min(8 + struct.unpack_from("<Q", data)[0], len(data) - 16)
    for _ in range(chance.choice((1, 10, 1000))):
        at = chance.randrange(begin, len(data) - 8) & ~3
        changed[at : at + 4] = struct.pack("<f", chance.choice((float("nan"), float("inf"), 1e38, -1e38, -1e30, 1e-45)))
    return bytes(changed)


def zipped(data: bytes, chance: random.Random) -> bytes:
    """What is inside a stream of gzip, changed."""
    try:
        inside = gzip.decompress(data)
    except (OSError, EOFError, zlib.error):
        return raw(data, chance)
    return gzip.compress(raw(inside, chance), 1)


def older(data: bytes, chance: random.Random) -> bytes:
    """A .spz file of version 4 as one of version 3 or before, something inside changed."""
    try:
        version, count, degree, bits, flags, streams, table = struct.unpack_from("<IIBBBBI", data, 4)
        at, inside = table + 16 * streams, struct.pack("<4sIIBBBB", b"NGSP", 3, count, degree, bits, flags, 0)
        for i in range(streams):
            (size,) = struct.unpack_from("<Q", data, table + 16 * i)
            inside += zstandard.ZstdDecompressor().stream_reader(data[at : at + size]).read(1 << 22)
            at += size
    except (struct.error, zstandard.ZstdError):
        return zipped(data, chance)
    inside = inside[:4] + struct.pack("<I", chance.choice((1, 2, 3, 3, version))) + inside[8:]
    return gzip.compress(raw(inside, chance), 1)


def stream(data: bytes, chance: random.Random) -> bytes:
    """A .spz file of version 4 whose header or table is another, or one of whose streams is a bomb."""
    if len(data) < 64:
        return raw(data, chance)
    changed, at = bytearray(data), chance.choice((4, 8, 12, 14, 16, 32 + 8 * chance.randrange(4)))
    extreme = chance.choice(EXTREMES)[: chance.choice((1, 2, 4, 8))]
    changed[at : at + len(extreme)] = extreme
    return bytes(changed) + (zstandard.compress(bytes(BOMB)) if chance.random() < 0.3 else b"")


def bomb(data: bytes, chance: random.Random) -> bytes:
    """A small stream of gzip that unpacks to gigabytes, behind a header that says so or does not."""
    header = bytearray(struct.pack("<4sIIBBBB", b"NGSP", 3, 60, 1, 12, 0, 0))
    if chance.random() < 0.7:
        header[8:12] = struct.pack("<I", chance.choice((10**8, 10**7, 2**31, 2**32 - 1)))
    return gzip.compress(bytes(header), 1) + zeros() * 100


def archive(data: bytes, chance: random.Random) -> bytes:
    """An archive of pictures and JSON one of whose entries is another, is gone, or is a bomb."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as held:
            files = {name: held.read(name) for name in held.namelist()}
        name = chance.choice([*files, "meta.json"])
        way = chance.randrange(6)
        if way == 0:
            del files[name]
        elif way == 1:
            files[name] = bytes(BOMB)
        elif way == 2:
            other = chance.choice([*files])
            files[name], files[other] = files[other], files[name]
        elif name.endswith(".json"):
            files[name] = values(files[name], chance)
        elif way == 3:
            files[name] = picture(chance)
        else:
            files[name] = raw(files[name], chance)
    except (ValueError, LookupError, OSError, EOFError, NotImplementedError, RuntimeError, zipfile.BadZipFile):
        return raw(data, chance)
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as new:
        for name, inside in files.items():
            new.writestr(name, inside)
    return made.getvalue()


def picture(chance: random.Random) -> bytes:
    """A picture of one colour, often a very large one."""
    from PIL import Image

    made, size = io.BytesIO(), chance.choice(((1, 1), (8, 8), (4000, 4000), (16383, 30)))
    Image.new("RGBA", size, tuple(chance.randrange(256) for _ in range(4))).save(
        made, chance.choice(("WEBP", "PNG")), lossless=True
    )
    return made.getvalue()


def glb(data: bytes, chance: random.Random) -> bytes:
    """Binary glTF whose JSON is not what it was, or whose buffer is short."""
    if len(data) < 28:
        return raw(data, chance)
    (size,) = struct.unpack_from("<I", data, 12)
    text, buffer = data[20 : 20 + size], data[28 + size :]
    if chance.random() < 0.2:
        buffer = buffer[: chance.randrange(len(buffer) or 1)]
    else:
        text = values(text, chance)
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


@cache
def zeros() -> bytes:
    return gzip.compress(bytes(BOMB), 9)


def counts(data: bytes, chance: random.Random) -> bytes:
    """A binary model whose first number, how many there are, or one of those that follow, is another."""
    at = 0 if chance.random() < 0.5 else 8 * chance.randrange(1, 6)
    return data[:at] + chance.choice(EXTREMES) + data[at + 8 :]


WAYS: dict[str, tuple[Bend, ...]] = {
    ".json": (values,),
    ".gltf": (values,),
    ".jsonl": (rows,),
    ".txt": (words,),
    ".obj": (words,),
    ".off": (words,),
    ".png": (png,),
    ".ply": (ply,),
    ".npy": (npy, npy),
    ".las": (hostile.lidar, hostile.lidar),
    ".laz": (hostile.lidar, hostile.lidar),
    ".safetensors": (safetensors, numbers),
    ".packed": (packed, packed),
    ".spz": (older, stream, stream, bomb),
    ".sog": (archive, archive),
    ".glb": (glb, glb),
    ".bin": (counts,),
}
