"""Raw files of cameras (DNG, NEF, CR2, ARW ...), read by LibRaw through rawpy."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from ...errors import LumigraphError
from ..numbers import check_pixels
from .photo import Pattern, RawPhoto, srgb_from_camera

RAW_SUFFIXES = (
    ".dng", ".nef", ".nrw", ".cr2", ".cr3", ".crw", ".arw", ".srf", ".sr2", ".raf", ".orf", ".rw2", ".pef", ".srw",
    ".3fr", ".fff", ".iiq", ".erf", ".kdc", ".dcr", ".mrw", ".x3f", ".rwl",
)  # fmt: skip
QUARTER_TURNS = {0: 0, 3: 2, 5: 1, 6: 3}  # LibRaw's flip, and quarter turns to the left
TIFF_SIGNATURES = (b"II*\0", b"MM\0*")  # first bytes of most cameras' files
EXIF_TAGS = (
    "ExposureTime", "FNumber", "ISOSpeedRatings", "FocalLength", "FocalLengthIn35mmFilm", "DateTimeOriginal",
    "OffsetTimeOriginal", "SubsecTimeOriginal",
)  # fmt: skip
_PRINTING = threading.Lock()
_silenced, _stderr = 0, -1  # threads that are silent, and where the others' words go afterwards


def open_file(path: Path) -> RawPhoto:
    """Open a camera's raw file and read its metadata. Raises LumigraphError if rawpy is not installed, for unsupported
    cameras, truncated files, and filters other than Bayer's."""
    with opened(path) as raw:
        width, height = raw.sizes.width, raw.sizes.height
        try:
            check_pixels((width, height))
        except ValueError as fault:
            raise LumigraphError(f"{path} cannot be read ({fault}); restore it") from fault
        turns = QUARTER_TURNS.get(raw.sizes.flip, 0)
        gains = np.array(raw.camera_whitebalance[:3], np.float64)
        if not (gains > 0).all():  # the camera did not judge
            gains = np.array(raw.daylight_whitebalance[:3], np.float64)
        matrix = colours_of(raw)
        about, pattern = raw.other, turned_pattern(bayer(raw, path), (width, height), turns)
    light = about.shutter_speed * (about.iso_speed or 100) / 100 / (about.aperture or 1) ** 2
    return RawPhoto(
        path,
        (height, width) if turns % 2 else (width, height),
        pattern,
        tuple((gains / gains[1]).tolist()) if (gains > 0).all() else (1.0, 1.0, 1.0),
        matrix,
        light if np.isfinite(light) and light > 0 else None,
        partial(read_light, path, turns),
    )


def read_light(path: Path, turns: int) -> np.ndarray:
    """The light of every pixel, 0 at black and 1 at white, upright; float32 (height, width)."""
    with opened(path) as raw:
        raw.unpack()
        black = np.array(raw.black_level_per_channel, np.float32)[raw.raw_colors_visible]
        light = (raw.raw_image_visible - black) / (np.float32(raw.white_level) - black)
    return np.ascontiguousarray(np.rot90(light, turns), np.float32)


def colours_of(raw: Any) -> np.ndarray:
    """Matrix from white-balanced camera colours to linear sRGB: the file's, else from LibRaw's table of cameras."""
    own = np.array(raw.color_matrix, np.float64)[:3, :3]
    if np.allclose(own.sum(-1), 1, atol=0.01):
        return own
    known = np.array(raw.rgb_xyz_matrix[:3], np.float64)
    return srgb_from_camera(known if np.isfinite(known).all() and abs(np.linalg.det(known)) > 1e-6 else None)


def bayer(raw: Any, path: Path) -> Pattern:
    """Bayer pattern of 2 x 2 pixels. Raises LumigraphError for any other."""
    pattern, colours = raw.raw_pattern, raw.color_desc.decode()
    if pattern is None or pattern.shape != (2, 2) or not set(colours) <= set("RGB"):
        raise LumigraphError(
            f"{path} has not the filters of Bayer's mosaic, which alone are read here; develop it elsewhere, to JPEG"
        )
    (a, b), (c, d) = ["RGB".index(colours[k]) for k in pattern[0]], ["RGB".index(colours[k]) for k in pattern[1]]
    return (a, b), (c, d)


def turned_pattern(pattern: Pattern, size: tuple[int, int], turns: int) -> Pattern:
    """Pattern of a picture of a size (width, height) after rotation by `turns` times 90 degrees anticlockwise."""
    few = np.tile(np.array(pattern), (2, 2))[: 2 + size[1] % 2, : 2 + size[0] % 2]  # it ends as the picture does
    (a, b), (c, d) = np.rot90(few, turns)[:2, :2].tolist()
    return (a, b), (c, d)


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Block without output on stderr, where LibRaw prints errors that it also raises."""
    global _silenced, _stderr
    with _PRINTING:
        if not _silenced:
            _stderr = os.dup(2)
            with open(os.devnull, "wb") as nothing:
                os.dup2(nothing.fileno(), 2)
        _silenced += 1
    try:
        yield
    finally:
        with _PRINTING:
            _silenced -= 1
            if not _silenced:
                os.dup2(_stderr, 2)
                os.close(_stderr)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """A file opened by LibRaw; any exception within the block becomes a LumigraphError of one sentence."""
    try:
        import rawpy
    except ImportError as fault:
        raise LumigraphError(
            f"{path} is a raw photograph, and rawpy, which reads those, is missing; pip install 'lumigraph[raw]'"
        ) from fault
    try:
        with silent(), rawpy.RawPy() as raw:
            raw.open_file(str(path))
            yield raw
    except rawpy.LibRawFileUnsupportedError as fault:
        raise LumigraphError(
            f"{path} is no raw file, or of a camera that LibRaw {'.'.join(map(str, rawpy.libraw_version))} does not "
            f"know; convert it to DNG"
        ) from fault
    except rawpy.LibRawError as fault:
        said = fault.args[0].decode() if fault.args and isinstance(fault.args[0], bytes) else str(fault)
        raise LumigraphError(f"{path} is cut short or damaged ({said.lower()}); restore it") from fault


def exif_of(path: Path) -> Image.Exif:
    """EXIF of a raw file, for the developed picture; empty for formats that are not TIFF inside."""
    told, found = Image.Exif(), Image.Exif()
    with open(path, "rb") as file, contextlib.suppress(Exception):  # Pillow raises anything for odd tags
        if file.read(4) in TIFF_SIGNATURES:
            file.seek(0)
            found.load_from_fp(file)
            for tag in (ExifTags.Base.Make, ExifTags.Base.Model):
                if tag in found:
                    told[tag] = found[tag]
            details = {**found, **found.get_ifd(ExifTags.IFD.Exif)}
            tags = [ExifTags.Base[name] for name in EXIF_TAGS]
            told.get_ifd(ExifTags.IFD.Exif).update({tag: details[tag] for tag in tags if tag in details})
            told.get_ifd(ExifTags.IFD.GPSInfo).update(found.get_ifd(ExifTags.IFD.GPSInfo))
    return told
