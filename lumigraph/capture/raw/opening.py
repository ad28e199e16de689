"""Open raw photographs by their file."""

from __future__ import annotations

from pathlib import Path

from . import library, mosaic_folder
from .photo import RawPhoto


def is_raw(path: Path) -> bool:
    """True if a file is a camera's raw file by its name, or listed as a mosaic in its folder."""
    return path.suffix.lower() in library.RAW_SUFFIXES or mosaic_folder.is_listed(path)


def open_raw(path: Path) -> RawPhoto:
    """A raw photograph, its pixels not yet read. Raises LumigraphError for what cannot be read, and why."""
    return library.open_file(path) if path.suffix.lower() in library.RAW_SUFFIXES else mosaic_folder.open_mosaic(path)
