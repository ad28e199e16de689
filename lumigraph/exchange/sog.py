"""PlayCanvas's SOG, Spatially Ordered Gaussians: pictures whose pixels are Gaussians, and meta.json beside them.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog. One .sog file (a .zip archive), or a folder
with the same files. Version 2 is written; 1, which had ranges where 2 has codebooks, is read too. Pixels of the same
position belong to the same Gaussian; the pictures are lossless WebP.

Losses: each axis of sign(x) log(1 + |x|) has 16 bits between its bounds, so positions are within
(1 + |x|) / 131070 of that range. Logarithms of scales, and colours of degree 0, are quantised to 256 levels fitted to
the cloud (`levels`). Components of a rotation other than the largest are within 0.0028, opacities within 1/510.
Harmonics beyond degree 0 are vector-quantised to at most 65536 palette entries, found by k-means, with numbers of 256
levels: their loss depends on the cloud; up to 1024 Gaussians each has an entry of its own.

Gaussians are written in Morton order, since similar neighbours compress well: the set is preserved, the order is not.
"""

from __future__ import annotations

import io
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image

from ..errors import LumigraphError
from ..files import from_json, read_bytes, replacing_folder, write_bytes
from ..files.ranges import Coordinate, Name, Tally, between, format_value, typed
from ..files.reading import reading
from ..gaussians import Gaussians
from .checks import Bundle, check_room, zipped
from .codes import (
    LOGITS,
    Quaternions,
    Vectors,
    alpha_to_byte,
    array,
    cloud,
    levels,
    morton_order,
    nearest_level,
    to_byte,
    with_largest,
    without_largest,
)
from .packing.forms import clustered

VERSION = 2
META = "meta.json"
LARGEST_COMPONENT_ALPHA = 252  # alpha of a rotation's pixel if w is the largest component; 253 to 255 for x, y, z
PALETTE_ROW = 64  # palette entries side by side
WIDTHS = 3, 8, 15  # coefficients of one, for degrees 1, 2 and 3
MIN_ENTRIES, MAX_ENTRIES = 1024, 65536  # palette entries
GAUSSIANS_PER_ENTRY = 8  # Gaussians at least for each, beyond a few: more entries cost more bytes than they save error
WEBP_EFFORT = 2  # of WebP, 0 to 6: 4 takes twice as long and saves 1 %
FORMATS = ("WEBP", "PNG")

Ends = tuple[Coordinate, Coordinate, Coordinate]
FourEnds = tuple[Coordinate, Coordinate, Coordinate, Coordinate]
Book = Annotated[tuple[Coordinate, ...], msgspec.Meta(min_length=256, max_length=256)]
One = tuple[Name]
Two = tuple[Name, Name]


@dataclass(frozen=True)
class QuantizedMeans:
    """Bounds of sign(x) log(1 + |x|), and the pictures of low and high bytes."""

    mins: Ends
    maxs: Ends
    files: Two


@dataclass(frozen=True)
class Quats:
    files: One


@dataclass(frozen=True)
class CodebookImage:
    codebook: Book
    files: One


@dataclass(frozen=True)
class Palette:
    """Harmonics beyond degree 0: the pictures of entries and of labels."""

    count: Annotated[int, between(1, MAX_ENTRIES)]
    bands: Annotated[int, between(1, 3)]
    codebook: Book
    files: Two


@dataclass(frozen=True)
class Meta:
    """Content of meta.json in version 2. antialias: earlier name of the model "antialiased"."""

    count: Tally
    means: QuantizedMeans
    scales: CodebookImage
    quats: Quats
    sh0: CodebookImage
    shN: Palette | None = None  # noqa: N815
    model: str | None = None
    antialias: bool = False


@dataclass(frozen=True)
class OldMeans(QuantizedMeans):
    shape: tuple[Tally, ...]


@dataclass(frozen=True)
class OldScales:
    mins: Ends
    maxs: Ends
    files: One


@dataclass(frozen=True)
class OldColours:
    """Bounds of colours of degree 0 and of the logit of opacity."""

    mins: FourEnds
    maxs: FourEnds
    files: One


@dataclass(frozen=True)
class OldPalette:
    mins: Coordinate
    maxs: Coordinate
    files: Two


@dataclass(frozen=True)
class OldMeta:
    """Content of meta.json in version 1, which has no version number."""

    means: OldMeans
    scales: OldScales
    quats: Quats
    sh0: OldColours
    shN: OldPalette | None = None  # noqa: N815


def recognises(folder: Path) -> bool:
    """True if a folder has a meta.json with pictures of means; False for a run's folder."""
    try:
        return b'"means"' in read_bytes(folder / META)
    except LumigraphError:
        return False


def read(path: Path) -> Gaussians:
    """Read a .sog file or a folder. Raises LumigraphError for pictures missing, truncated, too small or too large."""
    bundle = Bundle(path)
    fields = from_json(bundle.read(META), f"{META} of {path}")
    version = fields.get("version", 1) if isinstance(fields, dict) else None
    if version not in (1, VERSION):
        raise LumigraphError(
            f"{path} is of version {format_value(version)} of SOG, of which 1 and {VERSION} are read; "
            f"save it as {VERSION}"
        )
    return _read(bundle, fields) if version == VERSION else _read_old(bundle, fields)


def _read(bundle: Bundle, fields: Any) -> Gaussians:
    meta = typed(Meta, fields, f"{META} of {bundle.path}")
    count, palette = meta.count, meta.shN
    pictures = _Pictures(bundle, count, (palette.bands + 1) ** 2 if palette else 1)
    sh0 = pictures.of(meta.sh0.files[0])
    harmonics = np.array(meta.sh0.codebook)[sh0[:, :3]][:, None]
    if palette:
        entries, labels = pictures.palette(palette.files, palette.count, (palette.bands + 1) ** 2 - 1)
        harmonics = np.concatenate([harmonics, np.array(palette.codebook)[entries][labels]], 1)
    return cloud(
        pictures.means(meta.means),
        pictures.rotations(meta.quats.files[0]),
        np.array(meta.scales.codebook)[pictures.of(meta.scales.files[0])[:, :3]],
        LOGITS[sh0[:, 3]],
        harmonics,
        meta.antialias or meta.model == "antialiased",
    )


def _read_old(bundle: Bundle, fields: Any) -> Gaussians:
    """Read version 1, whose bytes are linear between bounds, and whose opacities are logits."""
    meta = typed(OldMeta, fields, f"{META} of {bundle.path}")
    count, palette = meta.means.shape[0] if meta.means.shape else 0, meta.shN
    pictures = _Pictures(bundle, count, 16 if palette else 1)
    colours = _between(pictures.of(meta.sh0.files[0]), meta.sh0.mins, meta.sh0.maxs)
    harmonics = colours[:, None, :3]
    if palette:
        entries, labels = pictures.palette(palette.files)
        harmonics = np.concatenate([harmonics, _between(entries, palette.mins, palette.maxs)[labels]], 1)
    return cloud(
        pictures.means(meta.means),
        pictures.rotations(meta.quats.files[0]),
        _between(pictures.of(meta.scales.files[0])[:, :3], meta.scales.mins, meta.scales.maxs),
        colours[:, 3],
        harmonics,
    )


def _between(codes: UInt8[np.ndarray, "*shape"], low: Any, high: Any) -> Float[np.ndarray, "*shape"]:
    return np.array(low) + codes / 255 * (np.array(high) - np.array(low))


class _Pictures:
    """Pixels of a bundle for `count` Gaussians, checked against the bundle's bytes and memory."""

    def __init__(self, bundle: Bundle, count: int, harmonics: int):
        if not count:
            raise LumigraphError(f"{bundle.path} declares that it holds no Gaussians; export it again")
        self.bundle, self.count, self.harmonics = bundle, count, harmonics
        check_room(bundle.path, count, harmonics, bundle.size, 20 * count)

    def of(self, name: str) -> UInt8[np.ndarray, "gaussian 4"]:
        """Red, green, blue and alpha of the first pixels, one for each Gaussian."""
        return self.whole(name, self.count).reshape(-1, 4)[: self.count]

    def whole(self, name: str, least: int) -> UInt8[np.ndarray, "row column 4"]:
        """A picture of at least so many pixels. Raises LumigraphError if it is invalid, smaller, or too large."""
        path, data = self.bundle.path, self.bundle.read(name)
        with (
            reading(f"{path}: {format_value(name)}", "cannot be read as a picture", "get it again"),
            Image.open(io.BytesIO(data), formats=FORMATS) as image,
        ):
            pixels = image.width * image.height
            if pixels < least:
                found = f"{format_value(name)} has {pixels:,} pixels where {least:,} are needed"
                raise LumigraphError(f"{path}: {found}; get it again")
            check_room(path, self.count, self.harmonics, self.bundle.size, 4 * pixels)
            return np.asarray(image.convert("RGBA"))

    def means(self, about: QuantizedMeans) -> Vectors:
        low, high = (self.of(name)[:, :3].astype(np.int64) for name in about.files)
        shares = (high << 8 | low) / 65535
        folded = np.array(about.mins) + shares * (np.array(about.maxs) - np.array(about.mins))
        with np.errstate(over="ignore"):  # infinite positions are found later
            return np.sign(folded) * np.expm1(np.abs(folded))

    def rotations(self, name: str) -> Quaternions:
        pixels = self.of(name)
        if (pixels[:, 3] < LARGEST_COMPONENT_ALPHA).any():
            raise LumigraphError(
                f"{self.bundle.path}: {format_value(name)} has pixels that are no rotations; export it again"
            )
        largest = pixels[:, 3].astype(np.int64) - LARGEST_COMPONENT_ALPHA
        return with_largest(largest, (pixels[:, :3] / 255 - 0.5) * math.sqrt(2))

    def palette(
        self, files: tuple[str, str], count: int | None = None, width: int | None = None
    ) -> tuple[UInt8[np.ndarray, "entry coefficient 3"], np.ndarray]:
        """Codes of each entry, and the entry of each Gaussian. count, width: of entries; None for those in the file"""
        image, pixels = self.whole(files[0], 1), self.of(files[1]).astype(np.int64)
        labels = pixels[:, 1] << 8 | pixels[:, 0]
        widths = [PALETTE_ROW * coefficients for coefficients in ([width] if width else WIDTHS)]
        fits = image.shape[1] in widths and labels.max() < min(count or MAX_ENTRIES, PALETTE_ROW * image.shape[0])
        if not fits:
            raise LumigraphError(
                f"{self.bundle.path}: {format_value(files[0])} of {image.shape[1]} x {image.shape[0]} pixels does not "
                f"hold the {labels.max() + 1:,} entries that {format_value(files[1])} names; export it again"
            )
        return image[..., :3].reshape(PALETTE_ROW * image.shape[0], -1, 3)[:count], labels


def write(path: Path, gaussians: Gaussians) -> None:
    """Write a .sog file, or the folder of a path to meta.json. Raises LumigraphError for an empty cloud."""
    if not len(gaussians):
        raise LumigraphError(f"{path} cannot hold a cloud of no Gaussians; write it as .ply")
    files = encode(gaussians)
    if path.name != META:
        write_bytes(path, zipped(files), "splats")
        return
    with replacing_folder(path.parent, "splats") as folder:
        for name, data in files.items():
            (folder / name).write_bytes(data)


def encode(gaussians: Gaussians, ordered: bool = False) -> dict[str, bytes]:
    """The files of version 2 by name, meta.json first. ordered: keep the order of the cloud."""
    gaussians = gaussians.to("cpu")
    if not ordered:
        gaussians = gaussians[torch.from_numpy(morton_order(array(gaussians.means)))]
    count, files = len(gaussians), dict[str, bytes]()

    def picture(name: str, *channels: np.ndarray, width: int = 4 * math.ceil(math.sqrt(count) / 4)) -> str:
        """Add a lossless WebP of pixels, padded with 255 to a multiple of four rows."""
        pixels = np.concatenate([part.reshape(len(part), -1) for part in channels], 1)
        rgba = np.full((4 * math.ceil(len(pixels) / width / 4) * width, 4), 255, np.uint8)
        rgba[: len(pixels), : pixels.shape[1]] = pixels
        held = io.BytesIO()
        Image.fromarray(rgba.reshape(-1, width, 4)).save(held, "WEBP", lossless=True, exact=True, method=WEBP_EFFORT)
        files[name] = held.getvalue()
        return name

    means = array(gaussians.means)
    folded = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    low, high = folded.min(0), folded.max(0)
    steps = np.rint(65535 * (folded - low) / np.where(high > low, high - low, 1)).astype(np.int64)
    largest, rest = without_largest(array(gaussians.quaternions))
    components, alphas = to_byte(255 * (rest / math.sqrt(2) + 0.5)), alpha_to_byte(array(gaussians.opacities))
    scales, colours = array(gaussians.log_scales), array(gaussians.harmonics[:, 0])
    scale_book, colour_book = levels(scales), levels(colours)
    meta: dict[str, Any] = {
        "version": VERSION,
        "asset": {"generator": "Lumigraph"},
        "count": count,
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": [picture("means_l.webp", steps & 255), picture("means_u.webp", steps >> 8)],
        },
        "scales": {
            "codebook": scale_book.tolist(),
            "files": [picture("scales.webp", nearest_level(scales, scale_book))],
        },
        "quats": {"files": [picture("quats.webp", components, LARGEST_COMPONENT_ALPHA + largest)]},
        "sh0": {
            "codebook": colour_book.tolist(),
            "files": [picture("sh0.webp", nearest_level(colours, colour_book), alphas)],
        },
    }
    if gaussians.antialiased:
        meta |= {"model": "antialiased", "antialias": True}
    if gaussians.degree:
        entries, labels = _palette(array(gaussians.harmonics[:, 1:]).reshape(count, -1))
        book = levels(entries)
        coefficients = entries.shape[1] // 3
        padded = np.pad(nearest_level(entries, book), [(0, -len(entries) % PALETTE_ROW), (0, 0)]).reshape(-1, 3)
        meta["shN"] = {
            "count": len(entries),
            "bands": gaussians.degree,
            "codebook": book.tolist(),
            "files": [
                picture("shN_centroids.webp", padded, width=PALETTE_ROW * coefficients),
                picture("shN_labels.webp", labels & 255, labels >> 8, np.zeros_like(labels)),
            ],
        }
    return {META: json.dumps(meta, allow_nan=False).encode(), **files}


def _palette(harmonics: Float[np.ndarray, "gaussian rest"]) -> tuple[Float[np.ndarray, "entry rest"], np.ndarray]:
    """Palette entries, and the entry of each Gaussian: the harmonics themselves if few, else by k-means."""
    size = max(MIN_ENTRIES, min(MAX_ENTRIES, 2 ** int(math.log2(max(len(harmonics) / GAUSSIANS_PER_ENTRY, 1)))))
    kinds, labels = np.unique(harmonics, axis=0, return_inverse=True)
    if len(kinds) <= size:
        return kinds, labels.reshape(-1)
    rows = torch.from_numpy(np.ascontiguousarray(harmonics))
    entries, codes = clustered(rows, torch.ones(len(rows)), size, torch.Generator().manual_seed(0))
    return entries.numpy(), codes.numpy()
