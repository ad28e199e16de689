"""gather(): from what somebody points at to a list of pictures that cameras can be found for."""

from __future__ import annotations

import math
import os
import statistics
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

from PIL import Image

from ...errors import LumigraphError
from ..pictures import EXIF_ORIENTATION, EXIF_SIDEWAYS, describe, reductions
from . import upright
from .exif import read_facts
from .photo import Intake, Photo

PHOTOGRAPHS = {
    ".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif", ".avif"
}  # fmt: skip
POSES = (
    "transforms.json",
    "transforms_train.json",
    "sparse",
    "checkpoints",
)  # folders with these were made by programs

Track = Callable[[Iterable[Any], str, int], Iterator[Any]]  # the items one by one, while somebody is told how many


def untracked(items: Iterable[Any], description: str, total: int) -> Iterator[Any]:
    yield from items


def gather(sources: Sequence[Path], work: Path, frames: int | None = None, track: Track = untracked) -> Intake:
    """All pictures of a folder, a list of files, or a video.

    sources: one folder, one video, or image files
    work:    a folder for upright copies and a video's frames; what lies there already is used again if it still fits
    frames:  how many to take of a video; None: by its length
    track:   shows progress, as display.track does
    Raises LumigraphError where there is no picture to be had.
    """
    upright.learn_formats()
    files = named_files(list_photographs(sources, work))
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 16)) as pool:
        found = pool.map(lambda item: take(*item, work / "upright"), files.items())
        taken = dict(zip(files, track(found, "Looking at photographs", len(files)), strict=True))
    unreadable = {name: why for name, why in taken.items() if isinstance(why, str)}
    photos = sorted((p for p in taken.values() if isinstance(p, Photo)), key=lambda p: p.name)
    return Intake(", ".join(map(str, sources)), with_altitudes(photos), unreadable=unreadable)


def list_photographs(sources: Sequence[Path], work: Path) -> list[Path]:
    files: dict[Path, Path] = {}
    for source in sources:
        if not source.exists():
            raise LumigraphError(f"{source} does not exist; check the path")
        for file in [source] if source.is_file() else walk(source, work.resolve()):
            files.setdefault(file.resolve(), file)
    return list(files.values())


def walk(folder: Path, work: Path) -> Iterator[Path]:
    """Photographs below a folder, sorted: no hidden ones, none that a program reduced or rendered."""
    entries = sorted(folder.iterdir())
    folders = [entry for entry in entries if entry.is_dir()]
    reduced = {path for folder in folders for times, path in reductions(folder).items() if times > 1}
    for entry in entries:
        if entry.name.startswith(".") or entry in reduced or entry.resolve() == work:
            continue
        if entry.is_dir():
            if not any((entry / name).exists() for name in POSES):
                yield from walk(entry, work)
        elif entry.suffix.lower() in PHOTOGRAPHS:
            yield entry


def named_files(files: list[Path]) -> dict[str, Path]:
    """Each file by its path below the folder that all are in."""
    if not files:
        return {}
    common = Path(os.path.commonpath([file.absolute().parent for file in files]))
    return {file.absolute().relative_to(common).as_posix(): file for file in files}


def take(name: str, path: Path, copies: Path) -> Photo | str:
    """One photograph, copied where it has to be; or why it is none."""
    try:
        with Image.open(path) as image:
            facts = read_facts(image.getexif(), image.size)
            sideways = image.getexif().get(EXIF_ORIENTATION) in EXIF_SIDEWAYS
            size = image.size[::-1] if sideways else image.size
            if not upright.is_plain(image, path):
                copied = copies / f"{name}{upright.suffix(image)}"
                if not upright.is_current(copied, path):
                    upright.copy(image, path, copied)
                name, path = copied.relative_to(copies).as_posix(), copied
        return Photo(name, path, size, facts.device, facts.focal, facts.gps, facts.time)
    except LumigraphError:
        raise
    except Exception as fault:  # image libraries raise anything for a damaged file
        return describe(fault)


def with_altitudes(photos: list[Photo]) -> list[Photo]:
    """Where altitudes alone are missing, the others' median stands in."""
    known = [p.gps[2] for p in photos if p.gps and not math.isnan(p.gps[2])]
    usual = statistics.median(known) if known else 0.0
    return [replace(p, gps=(p.gps[0], p.gps[1], usual)) if p.gps and math.isnan(p.gps[2]) else p for p in photos]
