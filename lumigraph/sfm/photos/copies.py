"""Copies of photographs in a common format: developed raw files, rotated upright, or converted from rare formats."""

import os
import statistics
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

from PIL import Image

from ...color.tags import save_srgb
from ...errors import LumigraphError
from ...files import read_json, replacing, write_json
from ...geometry import evenly
from ...readers.pictures import EXIF_ORIENTATION, EXIF_UPRIGHT, HEIC_SUFFIXES, srgb_image
from ...readers.raw import RAW_FILE, Developed, RawPhoto, Remembered, exif_of, open_raw
from .photo import Track

PROBE_VIEWS = 8  # photographs that set the common brightness
PARALLEL_FILES = 2  # photographs in memory, each some ten times as large there as its file
JPEG_SUFFIXES, PNG_SUFFIXES = (".jpg", ".jpeg"), (".png",)
JPEG_QUALITY = 95  # with colours at full size: no visible difference
PNG_DEPTH_OFFSET = 24  # position of the bit depth in a PNG's header


def develop(files: Mapping[str, Path], folder: Path, track: Track) -> dict[str, Developed | str]:
    """Develop raw files: a JPEG NAME.jpg of each in a folder, or the reason for none, by the files' names.

    If every file has its exposure, all pictures show one light equally bright, independent of exposure times, so that a
    scene has one colour in all of them. Otherwise the brightness of each is chosen by itself. Files of an earlier call
    are reused if current.
    """
    opened: dict[str, RawPhoto | str] = {name: open_or_why(path) for name, path in files.items()}
    photos = {name: one for name, one in opened.items() if isinstance(one, RawPhoto)}
    record = folder / RAW_FILE
    before = read_json(record, Remembered).photographs if record.is_file() else {}
    common = brightness_of_all(list(photos.values()))

    def make(name: str) -> Developed | str:
        photo, target, known = photos[name], folder / f"{name}.jpg", before.get(name)
        try:
            wanted = None if common is None or photo.exposure is None else common / photo.exposure
            if known and is_current(target, photo.path) and known.brightness and wanted in (None, known.brightness):
                return known
            brightness = 1 / photo.highlight() if wanted is None else wanted
            write(photo, brightness, target)
        except LumigraphError as fault:
            return reason(photo.path, fault)
        return Developed(str(photo.path.resolve()), brightness)

    with ThreadPoolExecutor(PARALLEL_FILES) as pool:
        try:
            made = dict(
                zip(photos, track(pool.map(make, photos), "Developing raw photographs", len(photos)), strict=True)
            )
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    developed = Remembered({name: one for name, one in made.items() if isinstance(one, Developed)})
    write_json(record, asdict(developed), ours=True)
    return {name: made.get(name, opened[name]) for name in files}


def open_or_why(path: Path) -> RawPhoto | str:
    try:
        return open_raw(path)
    except LumigraphError as fault:
        return reason(path, fault)


def reason(path: Path, fault: LumigraphError) -> str:
    """Reason in a few words why a file cannot be used."""
    what, *_ = str(fault).split("; ")
    return f"it {what.removeprefix(f'{path} ')}" if what.startswith(f"{path} ") else what


def brightness_of_all(photos: list[RawPhoto]) -> float | None:
    """Factor on each photograph's light, times its exposure; None if some exposures are unknown."""
    found = []
    for photo in evenly(photos, PROBE_VIEWS):
        if photo.exposure is None:
            return None
        try:
            found.append(photo.exposure / photo.highlight())
        except LumigraphError:  # it will be said of this one when it is developed
            continue
    known = all(photo.exposure is not None for photo in photos)
    return statistics.median(found) if found and known else None


def write(photo: RawPhoto, brightness: float, target: Path) -> None:
    """Write a developed picture, with the raw file's EXIF and date."""
    picture = Image.fromarray(photo.developed(brightness))
    exif = exif_of(photo.path)
    with replacing(target, ours=True) as partial:
        save_srgb(picture, partial, "JPEG", quality=JPEG_QUALITY, subsampling=0, exif=exif)
        stat = photo.path.stat()
        os.utime(partial, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def is_plain(image: Image.Image, path: Path) -> bool:
    """True if OpenCV and COLMAP read this file correctly: JPEG or PNG, upright, 8 bits of grey or colour."""
    if image.getexif().get(EXIF_ORIENTATION) not in EXIF_UPRIGHT or path.suffix.lower() in HEIC_SUFFIXES:
        return False
    if image.format in ("JPEG", "MPO"):
        return image.mode in ("L", "RGB")
    return image.format == "PNG" and image.mode in ("L", "RGB", "RGBA") and bits(path) == 8


def bits(png: Path) -> int:
    with open(png, "rb") as file:
        return file.read(PNG_DEPTH_OFFSET + 1)[-1]


def name_of_copy(name: str, image: Image.Image) -> str:
    """Name of a copy: PNG stays PNG, alpha becomes PNG, the rest JPEG; a different suffix is added."""
    suffixes = PNG_SUFFIXES if image.format == "PNG" or image.has_transparency_data else JPEG_SUFFIXES
    return name if name.lower().endswith(suffixes) else name + suffixes[0]


def copy_upright(image: Image.Image, source: Path, path: Path) -> None:
    """An upright copy of an opened image in 8 bits and sRGB: JPEG, or PNG without loss, by the suffix of `path`.

    A copy has its source's date, by which `is_current` recognises it.
    Raises LumigraphError for a failed write, and Pillow's errors for a damaged image.
    """
    upright = srgb_image(image, turn=True)
    with replacing(path, ours=True) as partial:
        save(upright, partial, path.suffix)
        stat = source.stat()
        os.utime(partial, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def save(image: Image.Image, path: Path, suffix: str) -> None:
    """Write an image in sRGB as JPEG or PNG, as a suffix says."""
    if suffix.lower() in JPEG_SUFFIXES:
        save_srgb(image, path, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    else:
        save_srgb(image, path)


def is_current(path: Path, source: Path) -> bool:
    """True if a copy of this source exists there already."""
    return path.is_file() and path.stat().st_mtime_ns == source.stat().st_mtime_ns
