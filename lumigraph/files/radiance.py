"""Radiance pictures (.hdr, .pic): RGBE and XYZE, plain or run-length encoded, of any order of lines (Ward 1991)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from .reading import reads

RESOLUTION = re.compile(rb"\n([+-])([XY]) (\d+) ([+-])([XY]) (\d+)\n")
RGB_FROM_XYZ = np.array(
    [[2.690, -1.276, -0.414], [-1.022, 1.978, 0.044], [0.061, -0.224, 1.163]]
)  # Radiance's primaries
MIN_RUN_WIDTH, MAX_RUN_WIDTH = 8, 0x7FFF  # pixels of a line with runs for each channel
MAX_PIXELS_PER_BYTE = 128  # of a believable size; runs give up to 64


@reads()
def read_radiance(path: Path) -> Float[np.ndarray, "row column 3"]:
    """Linear radiance of a picture, upright. Raises ValueError for what is none."""
    data = path.read_bytes()
    size = RESOLUTION.search(data)
    if not data.startswith(b"#?") or size is None or b"\n\n" not in data[: size.start() + 1]:
        raise ValueError("it has no Radiance header")
    header = data[: size.start()].decode("latin-1")
    (first, major, lines, second, minor, width), place = size.groups(), size.end()
    rows, columns = int(lines), int(width)
    if major == minor or not 0 < rows * columns <= MAX_PIXELS_PER_BYTE * (len(data) - place):
        raise ValueError(f"it has {columns} x {rows} pixels in {len(data) - place} bytes")
    pixels = np.empty((rows, columns, 4), np.uint8)
    for row in range(rows):
        place = read_line(data, place, pixels[row])
    pixels = pixels[:: 1 if first == (b"-" if major == b"Y" else b"+") else -1]
    pixels = pixels[:, :: 1 if second == (b"+" if minor == b"X" else b"-") else -1]
    exponent = pixels[..., 3:].astype(np.int32)
    values = np.where(exponent > 0, np.ldexp(pixels[..., :3] + np.float32(0.5), exponent - 136), 0)
    for exposure in re.findall(r"^EXPOSURE\s*=\s*(\S+)", header, re.MULTILINE):
        values = values / float(exposure)
    for factors in re.findall(r"^COLORCORR\s*=\s*(\S+)\s+(\S+)\s+(\S+)", header, re.MULTILINE):
        values = values / np.array(factors, np.float64)
    if "32-bit_rle_xyze" in header:
        values = (values @ RGB_FROM_XYZ.T).clip(0)
    return np.ascontiguousarray(values if major == b"Y" else values.swapaxes(0, 1), np.float32)


def read_line(data: bytes, place: int, line: UInt8[np.ndarray, "column 4"]) -> int:
    """Fill a line of pixels from a place of the data. Returns the place behind it."""
    width = len(line)
    if MIN_RUN_WIDTH <= width <= MAX_RUN_WIDTH and data[place : place + 4] == bytes((2, 2, width >> 8, width & 255)):
        place += 4
        for channel in line.T:
            at = 0
            while at < width:
                count = data[place]
                run = count > 128  # of one value; else so many values
                count = count - 128 if run else count
                if not 0 < count <= width - at:
                    raise ValueError("a line of it has runs of another length than itself")
                channel[at : at + count] = np.frombuffer(data, np.uint8, 1 if run else count, place + 1)
                at, place = at + count, place + (2 if run else 1 + count)
        return place
    at = shift = 0
    while at < width:
        pixel = np.frombuffer(data, np.uint8, 4, place)
        place += 4
        if pixel[:3].tolist() == [1, 1, 1]:  # of the first format: as many of the pixel before
            count, shift = int(pixel[3]) << shift, shift + 8
            if not 0 < at <= width - count:
                raise ValueError("a line of it repeats more pixels than it has")
            line[at : at + count] = line[at - 1]
        else:
            count, shift = 1, 0
            line[at] = pixel
        at += count
    return place
