"""Raw numbers of files: photographs of more than eight bits, depth, labels, arrays.

Pillow keeps 16 bits of grey only, so colours of 16 bits go through FFmpeg (`av`), as films do.
"""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
from PIL import ExifTags, Image, TiffImagePlugin

from ..color.srgb import srgb_from_linear
from ..files.exr import picture_of, read_exr
from ..system.memory import free_memory

Tag = ExifTags.Base
PNG_SIGNATURE, EXR_SIGNATURE = b"\x89PNG\r\n\x1a\n", b"\x76\x2f\x31\x01"  # first bytes of these files
EXR_HALF = 1  # among the types of its channels
PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by PNG's colour type
TIFF_SUFFIXES, TIFF_FLOAT = (".tif", ".tiff"), 3  # and its sample format
PILLOW_TYPES = {"F": np.float32, "I": np.int32, "I;16": np.uint16, "I;16B": np.uint16}  # of its modes, .pfm and .pgm
MAX_SIDE, DECODING_COPIES = 10**5, 4  # pixels; and copies in memory while an image is decoded, turned and reduced
ARRAY_NAMES = {"labels": ("labels", "ids", "semantics")}  # accepted names in an .npz


@dataclass(frozen=True)
class Kind:
    """Description of a file's numbers from its header.

    size:     (width, height)
    channels: of a pixel
    linear:   whether they are light rather than colours encoded as sRGB
    """

    size: tuple[int, int]
    dtype: np.dtype
    channels: int
    linear: bool = False

    def __post_init__(self) -> None:
        check_pixels(self.size, self.dtype.itemsize * self.channels)

    @property
    def deep(self) -> bool:
        """True for more than eight bits, in 1, 3 or 4 channels."""
        return self.dtype.itemsize > 1 and self.channels in (1, 3, 4)

    @property
    def encoding(self) -> str:
        """Encoding of the layer that holds it; floating-point colours are premultiplied by alpha."""
        if not self.linear:
            return "sRGB"
        return "linear premultiplied" if self.dtype.kind == "f" and self.channels == 4 else "linear"


def check_pixels(size: tuple[int, int], each: int = 4) -> None:
    """Raise ValueError for an implausible picture size, or one that exceeds free memory.

    each: bytes of a pixel
    """
    width, height = size
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise ValueError(f"it says that it has {width}x{height} pixels")
    needed, free = DECODING_COPIES * each * width * height, free_memory()
    if needed > free:
        raise ValueError(
            f"its {width}x{height} pixels take {needed / 1e9:.1f} GB to read, and {free / 1e9:.1f} GB are free"
        )


def load_array(path: Path) -> Any:
    """Load a file by np.load without pickles, within the file's bytes and free memory. Raises ValueError and others."""
    if not zipfile.is_zipfile(path):
        return np.load(path, mmap_mode="r", allow_pickle=False)
    with zipfile.ZipFile(path) as packed:
        unpacked = sum(member.file_size for member in packed.infolist())
    if unpacked > free_memory():
        raise ValueError(f"it unpacks to {unpacked / 1e9:.1f} GB, more than is free")
    return np.load(path, allow_pickle=False)


def kind_of(path: Path, name: str = "") -> Kind:
    """Read a file's header. name: of the array, in a file of several."""
    suffix = path.suffix.lower()
    if suffix in (".npy", ".npz"):
        array = read_array(path, name)
        return Kind((array.shape[1], array.shape[0]), array.dtype, 1 if array.ndim == 2 else array.shape[2])
    if suffix == ".exr":
        return exr_kind(path)
    if suffix == ".png":
        with open(path, "rb") as file:
            header = file.read(26)
        if header.startswith(PNG_SIGNATURE):
            width, height, bits, colour = struct.unpack_from(">IIBB", header, 16)
            if bits < 16:
                return Kind((width, height), np.dtype(np.uint8), PNG_CHANNELS.get(colour, 1))
            with Image.open(path) as image:
                linear = image.info.get("gamma") == 1.0
            return Kind((width, height), np.dtype(np.uint16), PNG_CHANNELS.get(colour, 1), linear)
    if is_tiff(path):
        tags = tiff_tags(path)
        bits, channels = max(tags.get(Tag.BitsPerSample, (1,))), int(tags.get(Tag.SamplesPerPixel, 1))
        size = int(tags[Tag.ImageWidth]), int(tags[Tag.ImageLength])
        if TIFF_FLOAT in tags.get(Tag.SampleFormat, (1,)):
            return Kind(size, np.dtype(f"f{bits // 8}"), channels, True)
        return Kind(size, np.dtype(f"u{max(bits // 8, 1)}"), channels)
    with Image.open(path) as image:
        return Kind(image.size, np.dtype(PILLOW_TYPES.get(image.mode, np.uint8)), len(image.getbands()))


def is_tiff(path: Path) -> bool:
    """True for a file of TIFF's suffix that is no other kind of picture under that name."""
    if path.suffix.lower() not in TIFF_SUFFIXES:
        return False
    with open(path, "rb") as file:
        return file.read(4)[:2] in (b"II", b"MM") or path.stat().st_size < 4


def tiff_tags(path: Path) -> Mapping[int, Any]:
    """Tags of a TIFF file, also of one whose pixel format Pillow cannot open."""
    with open(path, "rb") as file:
        header = file.read(8)
        header += file.read(8) if header[2:4] in (b"\x2b\0", b"\0\x2b") else b""  # the large kind of TIFF
        tags = TiffImagePlugin.ImageFileDirectory_v2(header)
        file.seek(tags.next)
        tags.load(file)
    return tags


def exr_kind(path: Path) -> Kind:
    """Read an OpenEXR header: attributes as name, type, size and data, ended by an empty name."""
    with open(path, "rb") as file:
        data = file.read(1 << 16)
    if not data.startswith(EXR_SIGNATURE):
        raise ValueError("it is no OpenEXR file")
    found, at = {}, 8
    while data[at]:
        name_ends = data.index(b"\0", at)
        type_ends = data.index(b"\0", name_ends + 1)
        (size,) = struct.unpack_from("<i", data, type_ends + 1)
        found[data[at:name_ends].decode()] = data[type_ends + 5 : type_ends + 5 + size]
        at = type_ends + 5 + size
    left, top, right, bottom = struct.unpack("<4i", found["dataWindow"])
    check_pixels((right - left + 1, bottom - top + 1))
    left, top, right, bottom = struct.unpack("<4i", found["displayWindow"])
    names, types, at = [], [], 0
    while (channels := found["channels"])[at]:
        name_ends = channels.index(b"\0", at)
        names.append(channels[at:name_ends].decode())
        types.append(struct.unpack_from("<i", channels, name_ends + 1)[0])
        at = name_ends + 17
    dtype = np.dtype(np.float16 if all(kind == EXR_HALF for kind in types) else np.float32)
    picture = picture_of(names) or names[:1]
    if len(picture) == 3 and picture[0].endswith("Y"):
        dtype = np.dtype(np.float32)  # colours are computed
    return Kind((right - left + 1, bottom - top + 1), dtype, len(picture), True)


def read_numbers(path: Path, name: str = "") -> np.ndarray:
    """All numbers as stored, (height, width) or (height, width, channels). name: as in `kind_of`"""
    if path.suffix.lower() in (".npy", ".npz"):
        return read_array(path, name)
    if path.suffix.lower() == ".exr":
        return read_exr(path).astype(exr_kind(path).dtype)
    kind, tiff = kind_of(path), is_tiff(path)
    of_pillow = kind.channels == 1 and kind.dtype.kind in "fi"  # unknown to FFmpeg, or of another order there
    if kind.deep and not of_pillow:
        with open(path, "rb") as file, av.open(file, "r") as container:
            return next(container.decode(video=0)).to_ndarray().astype(kind.dtype)
    with Image.open(path) as image:
        image.load()  # turns a TIFF upright, which np.asarray would not notice
        values = np.asarray(image).astype(kind.dtype)
    orientation = tiff_tags(path).get(Tag.Orientation, 1) if tiff else 1
    return turned(values, {6: 8, 8: 6}.get(orientation, orientation))  # back to as it is stored


def read_array(path: Path, name: str) -> np.ndarray:
    """Array of a NumPy file; of several that of the given name."""
    found = load_array(path)
    if isinstance(found, np.ndarray):
        array = found
    else:
        with found:
            wanted = [k for k in ARRAY_NAMES.get(name, (name,)) if k in found.files] or list(found.files)
            if len(wanted) != 1:
                raise ValueError(f"it holds {', '.join(found.files)}, and none is called {name}")
            array = found[wanted[0]]
    array = array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array
    if array.dtype.kind not in "biuf":
        raise ValueError(f"it holds {array.dtype}, where a picture has numbers")
    if array.ndim not in (2, 3):
        raise ValueError(f"it holds an array of {array.ndim} axes, where a picture has two or three")
    return array


def turned(values: np.ndarray, orientation: int | None) -> np.ndarray:
    """Pixels rotated upright by EXIF's orientation."""
    if orientation in (5, 6, 7, 8):
        values = values.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        values = values[::-1]
    return values[:, ::-1] if orientation in (2, 3, 6, 7) else values


def as_bytes(values: np.ndarray, encoding: str) -> np.ndarray:
    """RGB or RGBA of more than eight bits as sRGB-encoded bytes, not premultiplied."""
    found = values.astype(np.float64)
    found = np.nan_to_num(found) if values.dtype.kind == "f" else found / np.iinfo(values.dtype).max
    if encoding == "linear premultiplied":
        found[..., :3] /= np.where(found[..., 3:] > 0, found[..., 3:], 1)
    if encoding != "sRGB":
        found[..., :3] = srgb_from_linear(found[..., :3].clip(0, 1))
    return np.rint(found.clip(0, 1) * 255).astype(np.uint8)
