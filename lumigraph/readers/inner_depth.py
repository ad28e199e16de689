"""Embedded depth of phone photographs: auxiliary images of HEIC, Dynamic Depth and its predecessor GDepth in JPEG.

A stored v in [0, 1] is Z = near + v (far - near) for "linear", 1 / Z = 1 / far + v (1 / near - 1 / far) for an inverse
(HEIC) and, in Android, Z = far near / (far - v (far - near)) (RangeInverse). Depth is along the optical axis unless
Dynamic Depth declares it along the ray.
"""

from __future__ import annotations

import base64
import io
import math
import re
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image

from ..files import read_bytes
from .capture import Capture, PixelPlane, Shot
from .numbers import turned
from .pictures import EXIF_SIDEWAYS, EXIF_UPRIGHT, HEIC_SUFFIXES, measure, readable, reads_heic, same_shape, stat

JPEG_SUFFIXES = (".jpg", ".jpeg")
XMP, MORE_XMP = b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0"
HEAD_BYTES = 1 << 17  # of a JPEG, within which the first part of XMP lies
GUID_BYTES = 32 + 8  # of a further part of XMP ahead of its text: a name, a length, a place
FIELD = re.compile(r'\b(G?Depth):(\w+)\s*(?:=\s*"([^"]*)"|>([^<]*)<)')
ITEM = re.compile(r"<Container:Item\b(.*?)/?>", re.DOTALL)
ITEM_FIELD = re.compile(r'Item:(\w+)\s*=\s*"([^"]*)"')
UNITS = {"": 1.0, "m": 1.0, "meters": 1.0, "mm": 1e-3, "millimeters": 1e-3}
LINEAR_HEIC = (2, "uniform_Z")  # representations of HEIC's depth that are no inverse: libheif's number and name


@dataclass(frozen=True)
class InnerDepth:
    """Embedded depth of one photograph as stored.

    values:    in [0, 1]
    near, far: metres
    kind:      "linear", "inverse" (1 is near), or "range inverse" (1 is far)
    along_ray: whether it is measured along the ray
    """

    values: Float[np.ndarray, "height width"]
    near: float
    far: float
    kind: str
    along_ray: bool = False

    @property
    def metres(self) -> Float[np.ndarray, "height width"]:
        """Depth in metres; NaN for unknown or infinite depth."""
        v = self.values.astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.kind == "linear":
                found = self.near + v * (self.far - self.near)
            elif self.kind == "inverse":
                low = 0.0 if math.isinf(self.far) else 1 / self.far
                found = 1 / (low + v * (1 / self.near - low))
            else:
                found = self.far * self.near / (self.far - v * (self.far - self.near))
        return np.where(np.isfinite(found) & (found > 0), found, np.nan).astype(np.float32)


def with_inner_depth(capture: Capture) -> Capture:
    """The capture with embedded depth, for photographs without other depth."""
    if any("depth" in shot.planes for shot in capture.shots):
        return capture
    return replace(capture, shots=[with_own_depth(shot) for shot in capture.shots])


def with_own_depth(shot: Shot) -> Shot:
    if not isinstance(shot.image, dict):
        return shot
    path = shot.image[min(shot.image)]
    if not path.is_file() or (found := inner_depth(path)) is None:
        return shot
    (width, height), orientation = measure(path)
    upright = (height, width) if orientation in EXIF_SIDEWAYS else (width, height)
    turns = orientation not in EXIF_UPRIGHT and (shot.size is None or same_shape(upright, shot.size))
    plane = PixelPlane(
        partial(read_upright, path, orientation if turns else None),
        "distance" if found.along_ray else "z-depth",
        dtype=np.dtype(np.float32),
        identity=f"{path.resolve()} {stat(path)} depth {turns}",
    )
    return replace(shot, planes=shot.planes | {"depth": plane})


def read_upright(path: Path, orientation: int | None) -> Float[np.ndarray, "height width"]:
    found = inner_depth(path)
    assert found is not None
    return turned(found.metres, orientation)


def inner_depth(path: Path) -> InnerDepth | None:
    """Embedded depth of a photograph; None without one, or if it is not metric."""
    suffix = path.suffix.lower()
    with readable(path):
        if suffix in HEIC_SUFFIXES:
            return of_heic(path)
        if suffix not in JPEG_SUFFIXES:
            return None
        with open(path, "rb") as file:
            told = b"Depth:" in file.read(HEAD_BYTES)
        return of_jpeg(read_bytes(path)) if told else None


def of_heic(path: Path) -> InnerDepth | None:
    """Auxiliary depth of a HEIC, whose range is that of its depth representation."""
    if not reads_heic():
        return None
    with Image.open(path) as image:
        maps = image.info.get("depth_images") or []
        if not maps:
            return None
        stored, about = maps[0].to_pillow(), maps[0].info.get("metadata") or {}
    values = np.asarray(stored, np.float64)
    values = (values if values.ndim == 2 else values[..., 0]) / (65535 if stored.mode.startswith("I") else 255)
    if about.get("representation_type") in LINEAR_HEIC:
        near, far = about.get("z_near"), about.get("z_far")
        kind = "linear"
    else:  # disparity, 1 over metres
        low, high = about.get("d_min"), about.get("d_max")
        near = 1 / high if high else about.get("z_near")
        far = (1 / low if low else math.inf) if high else about.get("z_far")
        kind = "inverse"
    return InnerDepth(values, near, far, kind) if near and far and far > near > 0 else None


def of_jpeg(data: bytes) -> InnerDepth | None:
    """Depth of Dynamic Depth, a picture appended to the photograph, or of GDepth, a picture within its XMP."""
    text = xmp_of(data)
    if "Depth:" not in text:
        return None
    about: dict[str, str] = {}
    for _, name, quoted, inner in FIELD.findall(text):
        about.setdefault(name, quoted or inner)
    picture = base64.b64decode(about["Data"]) if "Data" in about else item_of(data, text)
    scale = UNITS.get(about.get("Units", "").lower())
    if picture is None or scale is None or "Near" not in about or "Far" not in about:
        return None
    with Image.open(io.BytesIO(picture)) as image:
        deep = image.mode.startswith("I")
        values = np.asarray(image if deep else image.convert("L"), np.float64) / (65535 if deep else 255)
    near, far = (scale * float(about[name]) for name in ("Near", "Far"))
    kind = "linear" if about.get("Format") == "RangeLinear" else "range inverse"
    along_ray = about.get("MeasureType") == "OpticRay"
    return InnerDepth(values, near, far, kind, along_ray) if math.inf > far > near > 0 else None


def xmp_of(data: bytes) -> str:
    """All of a JPEG's XMP, further parts included."""
    main, more, place = b"", b"", 2
    while data[:2] == b"\xff\xd8" and place + 4 <= len(data) and data[place] == 0xFF and data[place + 1] != 0xDA:
        size = int.from_bytes(data[place + 2 : place + 4])
        part = data[place + 4 : place + 2 + size]
        if data[place + 1] == 0xE1 and part.startswith(XMP):
            main += part[len(XMP) :]
        elif data[place + 1] == 0xE1 and part.startswith(MORE_XMP):
            more += part[len(MORE_XMP) + GUID_BYTES :]
        place += 2 + size
    return (main + more).decode("utf-8", "replace")


def item_of(data: bytes, text: str) -> bytes | None:
    """The depth picture among those appended to a photograph."""
    items = [dict(ITEM_FIELD.findall(one)) for one in ITEM.findall(text)]
    lengths = [int(item.get("Length") or 0) for item in items]
    for i, item in enumerate(items):
        if item.get("Semantic") == "Depth" and lengths[i]:
            start = len(data) - sum(lengths[i:])
            return data[start : start + lengths[i]] if start > 0 else None
    return None
