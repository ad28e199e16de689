"""Niantic's compact format, https://github.com/nianticlabs/spz: a header and one stream of bytes per quantity.

Versions 1 to 3 have gzip around all of it, version 4 a table of streams, each packed by zstd. All four are read, and 4,
the current one, is written; pages hold 3, which unpacks where there is no zstd and is the same. Both give a rotation
three components of 10 bits. Version 2 is within 1/255 a component, so that a half turn, whose w is near 0, can come
back turned by 13 degrees.

Axes are x right, y up, z back: see `codes.TURN_MEAN`. Adobe's extension names others (`in_system`). Further extensions,
and harmonics of degree 4, are passed over with a warning.

What is lost: positions are fixed-point numbers of 24 bits, within 2^-17 while all lie inside ±128, coarser for wider
clouds. Scales are within 1/32 (3%) of their logarithm from -10 to 5.9. Opacities are within 1/510, plain colours within
0.0037 from -0.44 to 1.44; harmonics, cut to [-1, 1), within 1/32 for degree 1 and 1/16 for 2 and 3. Components of a
rotation other than the largest are within 0.0007. Before it is packed a Gaussian
takes 20 bytes and 3 (K - 1) of harmonics.
"""

from __future__ import annotations

import gzip
import io
import math
import struct
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import zstandard
from jaxtyping import Float, UInt8

from ..errors import LumigraphError, LumigraphWarning
from ..files import write_bytes
from ..gaussians import Gaussians
from .checks import check_room
from .codes import (
    LOGITS,
    TURN_HARMONICS,
    TURN_MEAN,
    TURN_ROTATION,
    Quaternions,
    Vectors,
    alpha_to_byte,
    array,
    cloud,
    to_byte,
    with_largest,
    without_largest,
)
from .packing.streams import MAX_ZSTD_RATIO, take

HEADER = struct.Struct("<4sIIBBBB")  # magic, version, count, degree, bits behind the point, flags, reserved
MAGIC, GZIP_VERSION, NEWEST_VERSION = b"NGSP", 3, 4
HEADER_V4 = struct.Struct("<4sIIBBBBI12x")  # version 4: ..., flags, number of streams, where their table begins
STREAM = struct.Struct("<QQ")  # packed and unpacked bytes
ANTIALIASED, EXTENDED, LEVELS = 1, 2, 128  # flags; the last is Spark's, for a tree of levels of detail
MAX_BITS = 16  # behind the binary point; Niantic's metres have 12, ours are units of a scene in [-1, 1]^3
MAX_FIXED = 2**23 - 1
COLOUR_SCALE = 0.15  # instead of Y_00 = 0.28, so that colours outside [0, 1] have a place
HARMONICS_STEPS = 8, 16  # of 1/128, for harmonics of degree 1 and beyond: 5 and 4 bits
MAX_DEFLATE_RATIO = 1032  # times that deflate can shrink what it is given
MAX_EXTENSION_BYTES = 1 << 20  # bytes
MAX_DEGREE = 4  # of harmonics in a file
RECORD = struct.Struct("<II")  # of an extension: kind, bytes that follow
COORDINATE_SYSTEM = 0xADBE0003
EXTENSIONS = {COORDINATE_SYSTEM: "SPZ_ADOBE_coordinate_system", 0xADBE0002: "SPZ_ADOBE_safe_orbit_camera"}
SYSTEMS = "RUB LDB RDB LUB RUB LDF RDF LUF RUF LFD RFD LFU RFU LBD RBD LBU RBU".split()  # by number; 0 names none
DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
GZIP_LEVEL = 4  # of gzip; 6, the usual one, takes up to four times as long and saves 1% at most
ZSTD_LEVEL = 12


def read(path: Path) -> Gaussians:
    """Read versions 1 to 4. Raises LumigraphError for others and for damaged files."""
    data = path.read_bytes()
    stream: io.BufferedIOBase
    if data[:8] == MAGIC + struct.pack("<I", NEWEST_VERSION):
        return _decode_tabled(path, data)
    if data[:4] == MAGIC:  # earlier ones, before gzip
        stream = io.BytesIO(data)
    elif data[:2] == b"\x1f\x8b":
        stream = gzip.GzipFile(fileobj=io.BytesIO(data))
    else:
        raise LumigraphError(f"{path} is no .spz file, for it does not begin like one; name another one")
    return _decode(path, stream, MAX_DEFLATE_RATIO * len(data))


def write(path: Path, gaussians: Gaussians) -> None:
    """Write version 4. Raises LumigraphError if the cloud is too wide for 24 bits."""
    (bits, flags), streams = _streams(gaussians, str(path), HARMONICS_STEPS)
    raw = [stream.tobytes() for stream in streams if stream.shape[1]]
    packed = [zstandard.ZstdCompressor(ZSTD_LEVEL).compress(stream) for stream in raw]
    about = NEWEST_VERSION, len(gaussians), gaussians.degree, bits, flags, len(raw), HEADER_V4.size
    table = [STREAM.pack(len(few), len(many)) for few, many in zip(packed, raw, strict=True)]
    write_bytes(path, b"".join([HEADER_V4.pack(MAGIC, *about), *table, *packed]), "splats")


def gzipped(gaussians: Gaussians, steps: tuple[int, int] = HARMONICS_STEPS) -> bytes:
    """Bytes of version 3. steps: of 1/128, to which harmonics of degree 1 and beyond are rounded; 1 is the finest"""
    (bits, flags), streams = _streams(gaussians, "a .spz file", steps)
    header = HEADER.pack(MAGIC, GZIP_VERSION, len(gaussians), gaussians.degree, bits, flags, 0)
    return gzip.compress(b"".join([header, *(stream.tobytes() for stream in streams)]), GZIP_LEVEL, mtime=0)


def _streams(
    gaussians: Gaussians, name: str, steps: tuple[int, int]
) -> tuple[tuple[int, int], list[UInt8[np.ndarray, "gaussian width"]]]:
    """Number of fraction bits and flags, and the bytes of each quantity."""
    extent = float(np.abs(array(gaussians.means)).max()) if len(gaussians) else 0.0
    if extent > MAX_FIXED:
        raise LumigraphError(f"{name} cannot hold positions beyond {MAX_FIXED}; scale the cloud down or write a .ply")
    bits = min(MAX_BITS, math.floor(math.log2(MAX_FIXED / extent))) if extent > MAX_FIXED / 2**MAX_BITS else MAX_BITS
    flags = ANTIALIASED if gaussians.antialiased else 0
    fixed = np.rint(array(gaussians.means).astype(np.float64) * TURN_MEAN * 2**bits).clip(-MAX_FIXED, MAX_FIXED)
    harmonics = array(gaussians.harmonics) * TURN_HARMONICS[: gaussians.harmonics.shape[1]]
    return (bits, flags), [
        fixed.astype("<i4").reshape(-1, 1).view(np.uint8)[:, :3],
        alpha_to_byte(array(gaussians.opacities))[:, None],
        to_byte(255 * (COLOUR_SCALE * harmonics[:, 0] + 0.5)),
        to_byte(16 * (array(gaussians.log_scales) + 10)),
        _smallest_three(array(gaussians.quaternions) * TURN_ROTATION),
        _in_buckets(harmonics[:, 1:], steps).reshape(len(fixed), 3 * (harmonics.shape[1] - 1)),
    ]


def _decode(path: Path, stream: io.BufferedIOBase, limit: int) -> Gaussians:
    """The Gaussians of a decompressed stream of at most `limit` bytes."""
    magic, version = struct.unpack("<4sI", take(stream, 8))
    if magic != MAGIC:
        raise LumigraphError(f"{path} is no .spz file, for inside it does not begin with NGSP; name another one")
    if not 1 <= version < NEWEST_VERSION:
        raise LumigraphError(
            f"{path} is of version {version} of .spz, of which 1 to {NEWEST_VERSION} can be read; "
            f"save it as version {NEWEST_VERSION} or as .ply, for instance with splat-transform"
        )
    count, degree, bits, flags, _ = struct.unpack("<IBBBB", take(stream, 8))
    widths = _widths(path, version, degree)
    if count * sum(widths) > limit:
        raise EOFError(f"{count} Gaussians are promised and cannot be there")
    check_room(path, count, (degree + 1) ** 2, limit // MAX_DEFLATE_RATIO, count * sum(widths))
    columns = [np.frombuffer(take(stream, count * width), np.uint8).reshape(count, width) for width in widths]
    behind = stream.read(MAX_EXTENSION_BYTES + 1)  # to the end, where gzip's checksum is
    if flags & LEVELS:
        raise LumigraphError(f"{path} has levels of detail, which are not read; save it without them")
    if len(behind) > (MAX_EXTENSION_BYTES if flags & EXTENDED else 0):
        raise LumigraphError(f"{path} goes on after the {count} Gaussians that it promises; copy or download it again")
    return extended(path, _cloud(path, columns, version, bits, flags), behind)


def _decode_tabled(path: Path, data: bytes) -> Gaussians:
    """Read version 4. Each stream is unpacked to at most the size that follows from the header's count."""
    if len(data) < HEADER_V4.size:
        raise EOFError("it ends early")
    _, version, count, degree, bits, flags, streams, table = HEADER_V4.unpack_from(data)
    widths = _widths(path, version, degree)
    if streams < len([width for width in widths if width]) or table + streams * STREAM.size > len(data):
        raise EOFError(f"it has no table of {streams} streams")
    check_room(path, count, (degree + 1) ** 2, len(data), count * sum(widths))
    entries = [STREAM.unpack_from(data, table + i * STREAM.size) for i in range(streams)]
    at, columns = table + streams * STREAM.size, []
    for width, (packed, unpacked) in zip(widths, [*entries, (0, 0)], strict=False):
        if unpacked != count * width or at + packed > len(data):
            raise EOFError(f"{count} Gaussians are promised and cannot be there")
        found = b""
        if unpacked:
            if unpacked > MAX_ZSTD_RATIO * packed:
                raise EOFError(f"{count} Gaussians are promised and cannot be there")
            reader = zstandard.ZstdDecompressor().stream_reader(data[at : at + packed])
            found = take(reader, unpacked)
        columns.append(np.frombuffer(found, np.uint8).reshape(count, width))
        at += packed
    block = data[HEADER_V4.size : table] if flags & EXTENDED else b""
    return extended(path, _cloud(path, columns, version, bits, flags), block)


def _widths(path: Path, version: int, degree: int) -> list[int]:
    """Bytes of one Gaussian in each stream: position, opacity, colour, scale, rotation, harmonics beyond degree 0."""
    if degree > MAX_DEGREE:
        raise LumigraphError(f"{path} has harmonics of degree {degree}; save it with degree 0 to {MAX_DEGREE}")
    return [6 if version == 1 else 9, 1, 3, 3, 4 if version >= 3 else 3, 3 * ((degree + 1) ** 2 - 1)]


def _cloud(path: Path, columns: list[np.ndarray], version: int, bits: int, flags: int) -> Gaussians:
    positions, alphas, colours, scales, rotations, rest = columns
    means = positions.view("<f2").astype(np.float64) if version == 1 else _fixed_point(positions) / 2.0**bits
    if version >= 3:
        quaternions = _from_smallest_three(rotations)
    else:  # x, y, z, and w not negative
        quaternions = with_largest(np.zeros(len(rotations), np.int64), rotations / 127.5 - 1)
    plain = (colours / 255 - 0.5) / COLOUR_SCALE
    rest = (rest.reshape(len(rest), rest.shape[1] // 3, 3) - 128.0) / 128
    if rest.shape[1] >= len(TURN_HARMONICS):
        warnings.warn(f"{path}: harmonics of degree {MAX_DEGREE} are passed over", LumigraphWarning, stacklevel=3)
        rest = rest[:, : len(TURN_HARMONICS) - 1]
    harmonics = np.concatenate([plain[:, None], rest], 1)
    return cloud(
        means * TURN_MEAN,
        quaternions * TURN_ROTATION,
        scales / 16 - 10,
        LOGITS[alphas[:, 0]],
        harmonics * TURN_HARMONICS[: harmonics.shape[1]],
        bool(flags & ANTIALIASED),
    )


def extended(path: Path, gaussians: Gaussians, block: bytes) -> Gaussians:
    """The cloud with what the records of extensions mean. Warns of those that are passed over."""
    unused = []
    while len(block) >= RECORD.size:
        kind, size = RECORD.unpack_from(block)
        content, block = block[RECORD.size : RECORD.size + size], block[RECORD.size + size :]
        system = int.from_bytes(content, "little")
        if kind == COORDINATE_SYSTEM and len(content) == size == 4 and system < len(SYSTEMS):
            gaussians = in_system(gaussians, SYSTEMS[system])
        else:
            unused.append(EXTENSIONS.get(kind, f"{kind:#010x}"))
    if unused:
        warnings.warn(f"{path}: extensions passed over: {', '.join(unused)}", LumigraphWarning, stacklevel=3)
    return gaussians


def in_system(gaussians: Gaussians, axes: str) -> Gaussians:
    """A cloud whose numbers were read as x right, y up, z back, and mean three other directions, such as "RUF".

    Systems of the other hand mirror: M is -1 times a rotation, which turns the covariances, and harmonics of odd degree
    change sign.
    """
    matrix = np.array([DIRECTIONS[axis] for axis in axes], float).T * TURN_MEAN
    sign = round(np.linalg.det(matrix))
    place = np.eye(4)
    place[:3, :3] = sign * matrix
    turned = gaussians.transformed(torch.from_numpy(place), far=True)
    odd = torch.tensor([math.isqrt(i) % 2 for i in range(turned.harmonics.shape[1])], dtype=torch.bool)
    harmonics = torch.where(odd[:, None], sign * turned.harmonics, turned.harmonics)
    return replace(turned, means=sign * turned.means, harmonics=harmonics)


def _fixed_point(positions: UInt8[np.ndarray, "gaussian 9"]) -> Vectors:
    """Signed integers of 24 bits, read as the upper ones of 32."""
    wide = np.zeros((3 * len(positions), 4), np.uint8)
    wide[:, 1:] = positions.reshape(-1, 3)
    return (wide.view("<i4").reshape(-1, 3) >> 8).astype(np.float64)


def _from_smallest_three(rotations: UInt8[np.ndarray, "gaussian 4"]) -> Quaternions:
    """Quaternions of version 3: 2 bits name the largest of x, y, z, w; others have a sign and 9 bits of sqrt(1/2)."""
    code = rotations.view("<u4").astype(np.int64)
    parts = code >> np.array([20, 10, 0])
    rest = np.where(parts & 512, -1, 1) * (parts & 511) * (math.sqrt(0.5) / 511)
    return np.roll(with_largest((code >> 30)[:, 0], rest), 1, -1)


def _smallest_three(quaternions: Quaternions) -> UInt8[np.ndarray, "gaussian 4"]:
    largest, rest = without_largest(np.roll(quaternions, -1, -1))
    sizes = np.rint(np.abs(rest) * (511 / math.sqrt(0.5))).clip(0, 511).astype(np.int64)
    parts = (np.where(rest < 0, 512, 0) | sizes) << np.array([20, 10, 0])
    return (largest << 30 | parts.sum(-1)).astype("<u4")[:, None].view(np.uint8)


def _in_buckets(
    harmonics: Float[np.ndarray, "gaussian rest 3"], steps: tuple[int, int]
) -> UInt8[np.ndarray, "gaussian rest 3"]:
    """128 + 128 h to the nearest multiple of the band's step: fewer different bytes, which gzip packs better."""
    size = np.repeat(np.array(steps, np.float32), [3, 12])[: harmonics.shape[1], None]
    return to_byte(np.rint((harmonics + 1) * (128 / size)) * size)
