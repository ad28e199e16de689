"""Raw files of a scene's photographs, and their layers and metadata in the scene.

raw.json in a scene's folder names the files, as `lumigraph capture` writes it. Without it, they may be in a folder
`raw` beside the photographs, with the photographs' names (as in RawNeRF's published captures).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np

from ...errors import LumigraphError
from ...files import exists, read_json
from ...files.ranges import Name, between
from ..capture import Capture, PixelPlane, Shot
from ..masks import inner_names
from ..pictures import same_shape, stat
from . import library, mosaic_folder
from .photo import RawPhoto, repeated

RAW_FILE, RAW_FOLDER = "raw.json", "raw"
FILTERS = ("red", "green", "blue")
UNKNOWN_VALUE = -1


def is_raw(path: Path) -> bool:
    """True if a file is a camera's raw file by its name, or listed as a mosaic in its folder."""
    return path.suffix.lower() in library.RAW_SUFFIXES or mosaic_folder.is_listed(path)


def open_raw(path: Path) -> RawPhoto:
    """A raw photograph, its pixels not yet read. Raises LumigraphError for what cannot be read, and why."""
    return library.open_file(path) if path.suffix.lower() in library.RAW_SUFFIXES else mosaic_folder.open_mosaic(path)


@dataclass(frozen=True)
class Developed:
    """The raw file of a picture, and the brightness factor of its development; None if unknown."""

    file: Name
    brightness: Annotated[float, between(1e-9, 1e9)] | None = None


@dataclass(frozen=True)
class Remembered:
    """raw.json: raw files by the names of their pictures."""

    photographs: dict[Name, Developed] = field(default_factory=dict)


def with_raw(capture: Capture, folder: Path) -> Capture:
    """The capture with the raw files of its photographs, if any.

    Each gives two layers, `mosaic` and `filter`, and the values `exposure`, `white_balance`, `srgb_from_camera` and
    `brightness`. Raises LumigraphError for a missing file, or one with another shape than its picture.
    """
    known = raw_files(capture, folder)
    if not known:
        return capture
    shots = [with_its_raw(shot, known[shot.name]) if shot.name in known else shot for shot in capture.shots]
    told = list(capture.notes)
    if lacking := [shot.name for shot in shots if shot.name in known and "exposure" not in shot.about]:
        told.append(
            f"{len(lacking)} of {len(known)} raw files do not say how long they were exposed, such as that of "
            f"{lacking[0]}; a method of raw photographs learns their brightness instead"
        )
    return replace(capture, shots=shots, notes=told)


def raw_files(capture: Capture, folder: Path) -> dict[str, Developed]:
    """The raw files of a capture's photographs, by the photographs' names."""
    if exists(folder / RAW_FILE):
        files = read_json(folder / RAW_FILE, Remembered).photographs
    elif (folder / RAW_FOLDER).is_dir():
        by_stem = {path.stem: path for path in sorted((folder / RAW_FOLDER).iterdir()) if is_raw(path)}
        return {
            s.name: Developed(str(by_stem[k])) for s in capture.shots if (k := PurePosixPath(s.name).stem) in by_stem
        }
    else:
        return {}
    found = {shot.name: [files[name] for name in inner_names(shot.name) if name in files] for shot in capture.shots}
    return {name: one[0] for name, one in found.items() if one}


def with_its_raw(shot: Shot, developed: Developed) -> Shot:
    path = Path(developed.file)
    if not exists(path):
        raise LumigraphError(
            f"{path}, from which {shot.name} was developed, does not exist; bring it back, or delete {RAW_FILE} "
            f"to do without raw light"
        )
    photo = open_raw(path)
    if shot.size is not None and not same_shape(photo.size, shot.size):
        raise LumigraphError(
            f"{path} has {photo.size[0]}x{photo.size[1]} pixels, and {shot.name} {shot.size[0]}x{shot.size[1]}, "
            f"which is another shape; restore what was developed from it"
        )
    about = facts(photo, developed.brightness)
    return replace(shot, planes=shot.planes | planes(photo, f"{path} {stat(path)}"), about=shot.about | about)


def planes(photo: RawPhoto, identity: str | None = None) -> dict[str, PixelPlane]:
    """Layers of a raw photograph: each pixel's measurement, and its colour filter."""
    filters = partial(repeated, photo.pattern, photo.size)
    return {
        "mosaic": PixelPlane(photo.read, "mosaic", dtype=np.dtype(np.float32), identity=identity),
        "filter": PixelPlane(
            filters,
            "filter",
            unknown=(UNKNOWN_VALUE,),
            names=FILTERS,
            dtype=np.dtype(np.int8),
            identity=f"{photo.pattern}",
        ),
    }


def facts(photo: RawPhoto, brightness: float | None) -> dict[str, Any]:
    """Facts of a raw photograph, for `Scene.about`."""
    said = {
        "exposure": photo.exposure,
        "white_balance": np.array(photo.gains),
        "srgb_from_camera": photo.srgb_from_camera,
        "brightness": brightness,
    }
    return {k: v for k, v in said.items() if v is not None and not (isinstance(v, float) and math.isnan(v))}
