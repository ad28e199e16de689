"""Blender's synthetic scenes (Mildenhall et al. 2020): transforms_train.json etc., images with alpha.

Each file is a transforms.json; there is one for each split. Validation views are read only without test views, since
nothing uses both.
"""

from __future__ import annotations

from pathlib import Path

from .capture import Capture, Shot
from .transforms import read_frames_file, read_shots

EXPECTED_FILES = {"Blender, one file per split": ("transforms_train.json", "transforms_test.json")}


def recognises(folder: Path) -> bool:
    return (folder / "transforms_train.json").is_file()


def read(folder: Path) -> Capture:
    """The capture in a folder. Raises LumigraphError as `transforms.read` does."""
    held_out = next((s for s in ("test", "val") if (folder / f"transforms_{s}.json").is_file()), None)
    files = {"train": "train"} if held_out is None else {"train": "train", held_out: "test"}
    shots: list[Shot] = []
    missing: list[str] = []
    for file, split in files.items():
        path = folder / f"transforms_{file}.json"
        found, absent = read_shots(path, read_frames_file(path)[1], split if held_out else None)
        shots += found
        missing += absent
    return Capture(str(folder), shots, missing=missing)
