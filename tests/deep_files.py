"""Pictures of 16 bits and of floating point as files, written byte by byte, so that no library reads what it wrote."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np


def write_png16(path: Path, values: np.ndarray, gamma: int | None = None) -> None:
    """uint16 (height, width), (height, width, 3) or (height, width, 4). gamma: 100 000 says that it is light."""
    height, width = values.shape[:2]
    colour = {1: 0, 3: 2, 4: 6}[1 if values.ndim == 2 else values.shape[2]]
    rows = values.astype(">u2").reshape(height, -1)
    packed = zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows))
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, colour, 0, 0, 0))]
    chunks += [] if gamma is None else [(b"gAMA", struct.pack(">I", gamma))]
    chunks += [(b"IDAT", packed), (b"IEND", b"")]
    data = b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + data)


def write_exr(path: Path, values: np.ndarray) -> None:
    """float16 or float32, (height, width, 3) or (height, width, 4), not compressed."""
    height, width, channels = values.shape
    kind = {np.dtype(np.float16): 1, np.dtype(np.float32): 2}[values.dtype]
    names = sorted("RGBA"[:channels])
    listed = b"".join(n.encode() + b"\0" + struct.pack("<iBBBBii", kind, 0, 0, 0, 0, 1, 1) for n in names) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = b"\x76\x2f\x31\x01" + struct.pack("<i", 2)
    for name, type_, body in (
        ("channels", "chlist", listed),
        ("compression", "compression", b"\0"),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1.0)),
    ):
        header += name.encode() + b"\0" + type_.encode() + b"\0" + struct.pack("<i", len(body)) + body
    header += b"\0"
    order = ["RGBA".index(n) for n in names]
    lines = [np.ascontiguousarray(row[:, order].T).tobytes() for row in values]
    size = 8 + len(lines[0])
    offsets = [len(header) + 8 * height + y * size for y in range(height)]
    body = b"".join(struct.pack("<ii", y, len(line)) + line for y, line in enumerate(lines))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header + struct.pack(f"<{height}Q", *offsets) + body)
