"""EXIF of a photograph: lens, position and time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from PIL import ExifTags, Image

Tag, Gps = ExifTags.Base, ExifTags.GPS

FULL_FRAME_DIAGONAL = math.hypot(36, 24)  # mm, to which "35 mm equivalent" refers (CIPA DCG-001)
FOCAL_PLANE_UNITS = {1: 25.4, 2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # mm, of FocalPlaneResolutionUnit
SENSOR_WIDTHS = (2.0, 80.0)  # mm, the plausible range; beyond it the file's numbers are wrong
ASPECT_TOLERANCE = 0.02  # relative difference of aspect ratios that rounding explains


@dataclass(frozen=True)
class ExifFacts:
    """Facts of one exposure; None where the file has none, or an invalid one.

    device, focal, time: as in Photo
    gps: latitude and longitude in degrees, altitude in metres, NaN where that alone is missing
    """

    device: str | None = None
    focal: float | None = None
    gps: tuple[float, float, float] | None = None
    time: float | None = None


def read_facts(exif: Image.Exif, size: tuple[int, int]) -> ExifFacts:
    """The facts in an image's EXIF.

    size: (width, height) in pixels as stored
    """
    details = {**exif, **exif.get_ifd(ExifTags.IFD.Exif)}
    return ExifFacts(
        device(details, size),
        focal_length(details, size),
        position(exif.get_ifd(ExifTags.IFD.GPSInfo)),
        moment(details),
    )


def device(tags: dict[int, Any], size: tuple[int, int]) -> str | None:
    """Make, model, focal length and size: a key for pictures of one lens at one zoom setting."""
    make, model = text(tags.get(Tag.Make)), text(tags.get(Tag.Model))
    if not model:
        return None
    name = model if not make or model.lower().startswith(make.lower().split()[0]) else f"{make} {model}"
    focal = number(tags.get(Tag.FocalLength)) or number(tags.get(Tag.FocalLengthIn35mmFilm))
    parts = [name, *([f"{focal:g} mm"] if focal else []), f"{max(size)}x{min(size)}"]
    return ", ".join(parts)


def focal_length(tags: dict[int, Any], size: tuple[int, int]) -> float | None:
    """Focal length in pixels of a picture of `size`, which may be reduced or cropped since exposure, but not both.

    From the 35 mm equivalent f35, which compares diagonals: f35 / 43.27 mm = f / diagonal. Otherwise from the focal
    length in mm and the sensor's pixels per length. None where the original size has another aspect ratio and neither
    side matches: the reduction is then unknown.
    """
    # Software that turns a picture may leave the size at exposure as it was, hence the longer and the shorter side.
    long, short = max(size), min(size)
    said = [x for x in map(number, (tags.get(Tag.ExifImageWidth), tags.get(Tag.ExifImageHeight))) if x]
    exposed = (max(said), min(said)) if len(said) == 2 else (said[0], said[0] * short / long) if said else (long, short)
    cropped = abs(math.log(exposed[0] / exposed[1] * short / long)) > ASPECT_TOLERANCE
    if cropped and exposed[0] != long and exposed[1] != short:
        return None
    scale = 1.0 if cropped else long / exposed[0]
    if equivalent := number(tags.get(Tag.FocalLengthIn35mmFilm)):
        return scale * equivalent / FULL_FRAME_DIAGONAL * math.hypot(*exposed)
    length, density = number(tags.get(Tag.FocalLength)), number(tags.get(Tag.FocalPlaneXResolution))
    if not (length and density):
        return None
    per_mm = density / FOCAL_PLANE_UNITS.get(int(number(tags.get(Tag.FocalPlaneResolutionUnit)) or 2), 25.4)
    plausible = SENSOR_WIDTHS[0] < exposed[0] / per_mm < SENSOR_WIDTHS[1]
    return scale * length * per_mm if plausible else None


def exposure(exif: Image.Exif) -> float | None:
    """Exposure of a photograph up to a factor: seconds at f/1 and ISO 100, t S / (100 N^2).

    Missing aperture or sensitivity is assumed constant.
    """
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    seconds = number(tags.get(Tag.ExposureTime))
    if seconds is None:
        return None
    aperture, sensitivity = number(tags.get(Tag.FNumber)) or 1.0, number(tags.get(Tag.ISOSpeedRatings)) or 100.0
    return seconds * sensitivity / 100 / aperture**2


def position(tags: dict[int, Any]) -> tuple[float, float, float] | None:
    latitude = degrees(tags.get(Gps.GPSLatitude), tags.get(Gps.GPSLatitudeRef))
    longitude = degrees(tags.get(Gps.GPSLongitude), tags.get(Gps.GPSLongitudeRef))
    if latitude is None or longitude is None or abs(latitude) > 90 or abs(longitude) > 180:
        return None
    if latitude == 0 and longitude == 0:  # what receivers write that have found no satellite
        return None
    altitude = finite(tags.get(Gps.GPSAltitude))
    if altitude is None:
        return latitude, longitude, math.nan
    below_sea = tags.get(Gps.GPSAltitudeRef) in (1, b"\x01", "\x01", "1")
    return latitude, longitude, -altitude if below_sea else altitude


def degrees(parts: Any, side: Any) -> float | None:
    """Degrees from degrees, minutes and seconds; south and west are negative."""
    values = [finite(x) for x in parts] if isinstance(parts, tuple) else []
    if len(values) != 3 or values[0] is None:
        return None
    angle = sum((x or 0.0) / unit for x, unit in zip(values, (1, 60, 3600), strict=True))
    return -angle if text(side).upper() in ("S", "W") else angle


def moment(tags: dict[int, Any]) -> float | None:
    """Time of exposure in seconds since 1970; UTC if the file has no time zone."""
    try:
        taken = datetime.strptime(text(tags.get(Tag.DateTimeOriginal)), "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
    try:
        zone = datetime.strptime(text(tags.get(Tag.OffsetTimeOriginal)), "%z").tzinfo
    except ValueError:
        zone = UTC
    fraction = text(tags.get(Tag.SubsecTimeOriginal))
    return taken.replace(tzinfo=zone).timestamp() + (float(f"0.{fraction}") if fraction.isdecimal() else 0.0)


def number(value: Any) -> float | None:
    """A positive number, else None; EXIF writes zero for unknown."""
    found = finite(value)
    return found if found and found > 0 else None


def finite(value: Any) -> float | None:
    try:
        found = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return found if math.isfinite(found) else None


def text(value: Any) -> str:
    return value.strip(" \t\n\0") if isinstance(value, str) else ""
