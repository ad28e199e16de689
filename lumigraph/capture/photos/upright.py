"""Pictures as every program reads them: those that are turned by EXIF or in a rare format become copies."""

from __future__ import annotations

import contextlib
import importlib
import os
from pathlib import Path

from PIL import Image, ImageOps

from ...files import replacing
from ..pictures import EXIF_ORIENTATION, EXIF_UPRIGHT, eight_bits

JPEG_SUFFIXES, PNG_SUFFIXES = (".jpg", ".jpeg"), (".png",)
JPEG_QUALITY = 95  # with colours at full size: no visible difference
PNG_DEPTH_OFFSET = 24  # position of the bit depth in a PNG's header


def learn_formats() -> None:
    """Let Pillow read HEIC, where the package for it happens to be installed."""
    with contextlib.suppress(ImportError):
        importlib.import_module("pillow_heif").register_heif_opener()


def is_plain(image: Image.Image, path: Path) -> bool:
    """True if OpenCV and COLMAP read this file correctly: JPEG or PNG, upright, 8 bits of grey or colour."""
    if image.getexif().get(EXIF_ORIENTATION) not in EXIF_UPRIGHT:
        return False
    if image.format in ("JPEG", "MPO"):
        return image.mode in ("L", "RGB")
    return image.format == "PNG" and image.mode in ("L", "RGB", "RGBA") and bits(path) == 8


def bits(png: Path) -> int:
    with open(png, "rb") as file:
        return file.read(PNG_DEPTH_OFFSET + 1)[-1]


def name_of_copy(name: str, image: Image.Image) -> str:
    """PNG stays PNG, alpha becomes PNG, the rest JPEG; a name that says otherwise gets the right suffix added."""
    suffixes = PNG_SUFFIXES if image.format == "PNG" or image.has_transparency_data else JPEG_SUFFIXES
    return name if name.lower().endswith(suffixes) else name + suffixes[0]


def copy(image: Image.Image, source: Path, path: Path) -> None:
    """An upright copy of an opened image in 8 bits: JPEG, or PNG without loss, by the suffix of `path`.

    A copy carries its source's date, by which `is_current` knows it again.
    Raises LumigraphError where the disk refuses, and whatever Pillow raises for a damaged image.
    """
    upright = eight_bits(ImageOps.exif_transpose(image))
    with replacing(path, ours=True) as partial:
        save(upright, partial, path.suffix, image.info.get("icc_profile"))
        stat = source.stat()
        os.utime(partial, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def save(image: Image.Image, path: Path, suffix: str, profile: bytes | None = None) -> None:
    """Write an image as JPEG or PNG, as a suffix says. profile: of the image's colours (ICC)."""
    if suffix.lower() in JPEG_SUFFIXES:
        image.save(path, "JPEG", icc_profile=profile, quality=JPEG_QUALITY, subsampling=0)
    else:
        image.save(path, "PNG", icc_profile=profile)


def is_current(path: Path, source: Path) -> bool:
    """True if a copy of this source exists there already."""
    return path.is_file() and path.stat().st_mtime_ns == source.stat().st_mtime_ns
