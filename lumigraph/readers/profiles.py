"""Colours of photographs as their files describe them (ICC, nclx, cICP, EXIF), and their pixels as sRGB."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from PIL import ExifTags, Image, ImageCms

from ..color.display import ADOBE, is_srgb, srgb_of
from ..color.srgb import srgb_from_linear

DCF_ADOBE_RGB = "R03"  # EXIF's interoperability index of Adobe RGB, which many cameras write without a profile
SAME = 2  # bytes' difference at all probes, of a profile that is sRGB by another name
PROBES = np.stack(np.meshgrid(*[np.linspace(0, 255, 6)] * 3), -1).reshape(1, -1, 3).astype(np.uint8)
SPACES = {"RGB ": "RGB", "GRAY": "L", "CMYK": "CMYK", "Lab ": "LAB"}  # Pillow's mode of an ICC colour space
FROM_ICC = np.linalg.inv(  # XYZ of ICC's white, D50, to linear sRGB
    [[0.4360747, 0.3850649, 0.1430804], [0.2225045, 0.7168786, 0.0606169], [0.0139322, 0.0971045, 0.7141733]]
)
NCLX, CICP = b"colrnclx", b"cICP"  # boxes of HEIF and AVIF, chunks of PNG
PLACES = {
    "AVIF": (NCLX, ">HH"),
    "PNG": (CICP, ">BB"),
}  # by Pillow's name: what comes before the two numbers, their form
HEADER_BYTES = 1 << 16  # of a file, in which they lie

Kind = tuple[int, int]  # primaries and transfer, by the numbers of ITU-T H.273


@dataclass(frozen=True)
class Colours:
    """Colours of a photograph's pixels. profile: ICC; kind: where there is none. With neither they are sRGB."""

    profile: bytes = b""
    kind: Kind | None = None

    @property
    def are_srgb(self) -> bool:
        if self.profile:
            mode = mode_of(self.profile)
            return mode is None or (mode in ("RGB", "L") and transform_of(self.profile, mode) is None)
        return self.kind is None or is_srgb(*self.kind)

    def to_srgb(self, image: Image.Image) -> Image.Image:
        """An image of 8 bits a channel with its colours in sRGB; the image itself where they are, or where its channels
        are not those of its profile."""
        if self.are_srgb:
            return image
        colours, alpha = without_alpha(image)
        if self.profile:
            mode = mode_of(self.profile)
            colours = colours.convert("RGB") if mode == "RGB" and colours.mode == "P" else colours
            transform = transform_of(self.profile, colours.mode) if colours.mode == mode else None
            if transform is None:
                return image
            made = ImageCms.applyTransform(colours, transform)
            assert made is not None  # it is for inPlace alone
        else:
            signal = np.asarray(colours.convert("RGB")).astype(np.uint16) * 257
            made = Image.fromarray(np.rint(255 * self._encoded(signal)).astype(np.uint8))
        if alpha is not None:
            made.putalpha(alpha)
        return made

    def deep_to_srgb(self, values: np.ndarray) -> np.ndarray:
        """The same for integers of more than 8 bits, RGB or RGBA. A profile of tables is applied in 8 bits."""
        if self.are_srgb or values.dtype.kind != "u":
            return values
        most = np.iinfo(values.dtype).max
        signal = (values[..., :3].astype(np.float64) * (65535 / most)).round().astype(np.uint16)
        encoded = (self._encoded(signal) * most).round().astype(values.dtype)
        return np.concatenate([encoded, values[..., 3:]], -1)

    def _encoded(self, signal: np.ndarray) -> np.ndarray:
        """Colours from 0 to 1, encoded as sRGB, of a signal of 16 bits."""
        if not self.profile:
            assert self.kind is not None
            return srgb_of(signal, *self.kind)
        shaper = shaper_of(self.profile)
        if shaper is None:
            small = Image.fromarray((signal >> 8).astype(np.uint8))
            return np.asarray(self.to_srgb(small)) / 255
        curves, matrix = shaper
        light = np.stack([curve[signal[..., i]] for i, curve in enumerate(curves)], -1)
        return srgb_from_linear((light @ matrix.T).clip(0, 1))


def colours_of(image: Image.Image) -> Colours:
    """Colour description of an opened file."""
    if image.info.get("icc_profile"):
        return Colours(profile=image.info["icc_profile"])
    if (nclx := image.info.get("nclx_profile")) is not None:
        return Colours(kind=(int(nclx["color_primaries"]), int(nclx["transfer_characteristics"])))
    mark, form = PLACES.get(image.format or "", (b"", ""))
    if mark and (path := getattr(image, "filename", "")):
        with open(path, "rb") as file:
            header = file.read(HEADER_BYTES)
        at = header.find(mark)
        if at >= 0:
            primaries, transfer = struct.unpack_from(form, header, at + len(mark))
            return Colours(kind=(primaries, transfer))
    interop = image.getexif().get_ifd(ExifTags.IFD.Interop)
    return Colours(kind=(ADOBE, ADOBE) if interop.get(ExifTags.Interop.InteropIndex) == DCF_ADOBE_RGB else None)


def without_alpha(image: Image.Image) -> tuple[Image.Image, Image.Image | None]:
    """Colours, and alpha where an image has a channel of it."""
    if image.mode not in ("RGBA", "LA"):
        return image, None
    *bands, alpha = image.split()
    return Image.merge("RGB", bands) if len(bands) == 3 else bands[0], alpha


@lru_cache(64)
def mode_of(profile: bytes) -> str | None:
    """Pillow's mode of the images that a profile describes; None if it is damaged, or of a kind that none has."""
    try:
        return SPACES.get(ImageCms.ImageCmsProfile(io.BytesIO(profile)).profile.xcolor_space)
    except (OSError, ImageCms.PyCMSError):
        return None


@lru_cache(64)
def transform_of(profile: bytes, mode: str) -> ImageCms.ImageCmsTransform | None:
    """Conversion of a profile's colours to sRGB; None where they are sRGB, or the profile has none."""
    try:
        found = ImageCms.buildTransform(
            ImageCms.ImageCmsProfile(io.BytesIO(profile)),
            ImageCms.createProfile("sRGB"),
            mode,
            "RGB",
            ImageCms.Intent.RELATIVE_COLORIMETRIC,
            ImageCms.Flags.BLACKPOINTCOMPENSATION,
        )
    except (OSError, ImageCms.PyCMSError):
        return None
    if mode not in ("RGB", "L"):
        return found
    probes = Image.fromarray(PROBES if mode == "RGB" else np.ascontiguousarray(PROBES[..., 0]))
    apart = np.asarray(ImageCms.applyTransform(probes, found)).astype(int) - np.asarray(probes.convert("RGB"))
    return found if np.abs(apart).max() > SAME else None


@lru_cache(16)
def shaper_of(profile: bytes) -> tuple[list[Float[np.ndarray, " 65536"]], Float[np.ndarray, "3 3"]] | None:
    """Curves and matrix of an ICC profile, from a signal of 16 bits to linear sRGB; None if it has tables instead."""
    try:
        (count,) = struct.unpack_from(">I", profile, 128)
        entries = [struct.unpack_from(">4sII", profile, 132 + 12 * i) for i in range(min(count, 100))]
        bodies = {name: profile[at : at + size] for name, at, size in entries}
        if mode_of(profile) == "L":
            return [curve_of(bodies[b"kTRC"])] * 3, np.eye(3)
        xyz = [np.array(struct.unpack_from(">3i", bodies[name], 8)) / 65536 for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
        return [curve_of(bodies[name]) for name in (b"rTRC", b"gTRC", b"bTRC")], FROM_ICC @ np.stack(xyz, 1)
    except (KeyError, ValueError, struct.error):
        return None


def curve_of(body: bytes) -> Float[np.ndarray, " 65536"]:
    """A curve of an ICC profile (ICC.1, 10.6 and 10.18). Raises ValueError for one of another kind."""
    x = np.linspace(0, 1, 1 << 16)
    if body[:4] == b"curv":
        count = int.from_bytes(body[8:12])
        if count == 0:
            return x
        values = np.frombuffer(body, ">u2", count, 12)
        return x ** (values[0] / 256) if count == 1 else np.interp(x, np.linspace(0, 1, count), values / 65535)
    if body[:4] != b"para":
        raise ValueError("its curves are of an unknown kind")
    kind = int.from_bytes(body[8:10])
    g, a, b, c, d, e, f = (*struct.unpack_from(f">{(1, 3, 4, 5, 7)[kind]}i", body, 12), *[0] * 6)[:7]
    g, a, b, c, d, e, f = (value / 65536 for value in (g, a, b, c, d, e, f))
    if kind == 0:
        return x**g
    if kind in (1, 2):  # c is the constant above and, in 2, below
        return np.where(x >= -b / a, np.maximum(a * x + b, 0) ** g + c, c)
    return np.where(x >= d, np.maximum(a * x + b, 0) ** g + e, c * x + f)
