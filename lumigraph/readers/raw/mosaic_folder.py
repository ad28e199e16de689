"""Folder of mosaics: 16-bit grey PNG, or raw little-endian numbers (.raw), described by mosaics.json.

{"all": {"pattern": "RGGB", "black": 600, "white": 15520, "gains": [1.95, 1, 1.34], "width": 768, "height": 512},
 "photographs": {"a.raw": {"exposure": 0.1}, "b.raw": {"exposure": 0.025}}}
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from ...errors import LumigraphError
from ...files import read_json
from ...files.ranges import Coordinate, Name, Side, between
from ..numbers import check_pixels, kind_of, read_numbers
from ..pictures import readable
from .photo import RawPhoto, srgb_from_camera

LISTING_FILE, MOSAIC_SUFFIX = "mosaics.json", ".raw"
Level = Annotated[float, between(0, 65_535)]
Gain = Annotated[float, between(0.01, 100)]
Vector = tuple[Coordinate, Coordinate, Coordinate]


@dataclass(frozen=True)
class MosaicRecord:
    """Description of one mosaic, or of all in a folder.

    pattern:  colours of the filters over the first two pixels of the first row, then of the second
    black, white: black level and saturation level
    gains:    white balance of red, green and blue
    exposure: seconds, or any linear unit common to all
    colour_matrix: from CIE XYZ to the camera's colours, rows; DNG's ColorMatrix
    width, height: of .raw files, pixels
    """

    pattern: Literal["RGGB", "BGGR", "GRBG", "GBRG"] | None = None
    black: Level | None = None
    white: Level | None = None
    gains: tuple[Gain, Gain, Gain] | None = None
    exposure: Annotated[float, between(1e-9, 1e9)] | None = None
    colour_matrix: tuple[Vector, Vector, Vector] | None = None
    width: Side | None = None
    height: Side | None = None


@dataclass(frozen=True)
class Listing:
    """mosaics.json. Entries of a photograph override those of all."""

    photographs: dict[Name, MosaicRecord]
    all: MosaicRecord = field(default_factory=MosaicRecord)


def is_listed(path: Path) -> bool:
    """True if the folder of a file lists it as a mosaic."""
    listing = path.parent / LISTING_FILE
    return listing.is_file() and path.name in listed(listing, listing.stat().st_mtime_ns).photographs


@lru_cache(maxsize=8)
def listed(path: Path, date: int) -> Listing:
    return read_json(path, Listing)


def open_mosaic(path: Path) -> RawPhoto:
    """Open a mosaic listed in mosaics.json. Raises LumigraphError, naming both, for missing fields."""
    listing = path.parent / LISTING_FILE
    found = listed(listing, listing.stat().st_mtime_ns)
    own, common = found.photographs[path.name], found.all
    about = replace(common, **{name: value for name, value in vars(own).items() if value is not None})
    size = size_of(path, about)
    black, white, pattern = (needed(about, name, path) for name in ("black", "white", "pattern"))
    if white <= black:
        raise LumigraphError(
            f"{listing}: {path.name} has its white level {white:g} at or below black {black:g}; correct it"
        )
    a, b, c, d = ("RGB".index(colour) for colour in pattern)
    return RawPhoto(
        path,
        size,
        ((a, b), (c, d)),
        about.gains or (1.0, 1.0, 1.0),
        srgb_from_camera(None if about.colour_matrix is None else np.array(about.colour_matrix)),
        about.exposure,
        partial(read_light, path, size, black, white),
    )


def needed(about: MosaicRecord, name: str, path: Path):
    """Required fields of a mosaic's description."""
    value = getattr(about, name)
    if value is None:
        raise LumigraphError(
            f'{path.parent / LISTING_FILE} does not say the {name} of {path.name}; add it there, or to "all"'
        )
    return value


def size_of(path: Path, about: MosaicRecord) -> tuple[int, int]:
    """Width and height, checked against the file's size."""
    if path.suffix.lower() != MOSAIC_SUFFIX:
        with readable(path):
            kind = kind_of(path)
            if kind.dtype != np.uint16 or kind.channels != 1:
                raise ValueError("a mosaic is one number of 16 bits to a pixel")
            return kind.size
    width, height = needed(about, "width", path), needed(about, "height", path)
    with readable(path):
        check_pixels((width, height), 2)
        there = path.stat().st_size
    if there != 2 * width * height:
        raise LumigraphError(
            f"{path} has {there:,} bytes, and {width}x{height} pixels of 16 bits are {2 * width * height:,}; "
            f"restore it, or correct {path.parent / LISTING_FILE}"
        )
    return width, height


def read_light(path: Path, size: tuple[int, int], black: float, white: float) -> np.ndarray:
    """The light of every pixel, 0 at black and 1 at white; float32 (height, width)."""
    with readable(path):
        if path.suffix.lower() == MOSAIC_SUFFIX:
            numbers = np.fromfile(path, "<u2").reshape(size[::-1])
        else:
            numbers = read_numbers(path)
    return (numbers.astype(np.float32) - np.float32(black)) / np.float32(white - black)
