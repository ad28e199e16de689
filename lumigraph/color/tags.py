"""Pictures that are tagged as sRGB, so that programs with colour management show them as they are meant."""

import io
import struct
from pathlib import Path
from typing import Any

from PIL import Image, ImageCms
from PIL.PngImagePlugin import PngInfo

PERCEPTUAL = b"\0"  # rendering intent, the content of PNG's chunk sRGB
_made = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
SRGB_PROFILE = bytes(_made[:24] + struct.pack(">6H", 2020, 1, 1, 0, 0, 0) + _made[36:])  # of one date, for equal files


def save_srgb(image: Image.Image, target: Path | io.BytesIO, form: str = "PNG", **options: Any) -> None:
    """Write an image with its tag: the chunk sRGB of a PNG, the ICC profile of a JPEG or WebP.

    form: Pillow's name of the format. options: of Pillow, for the format
    """
    if form == "PNG":
        options.setdefault("pnginfo", PngInfo()).add(b"sRGB", PERCEPTUAL)
        options["icc_profile"] = None  # Pillow would write a profile that the image was read with instead
    else:
        options["icc_profile"] = SRGB_PROFILE
    image.save(target, form, **options)


def srgb_bytes(image: Image.Image, form: str = "PNG", **options: Any) -> bytes:
    """The file that `save_srgb` writes."""
    save_srgb(image, held := io.BytesIO(), form, **options)
    return held.getvalue()
