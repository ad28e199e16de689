"""Masks of photographs, by folder name, for every reader.

masks/          training masks: black (0) pixels are ignored, be it a passer-by, a hand or the sky. COLMAP's and
                nerfstudio's meaning.
object_masks/   silhouettes: black pixels are empty, so that the object stands alone. They become the photograph's
alpha.

labels/         class of each pixel, an integer: the layer `labels`. `lumigraph segment` writes such a folder.

A mask is named after its photograph, image.png or image.jpg.png for image.jpg, and has its shape, at any size.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath

from ..errors import LumigraphWarning
from .capture import Capture, PixelPlane
from .pictures import list_images

MASKS, OBJECT_MASKS, LABELS = "masks", "object_masks", "labels"
IMAGE_FOLDERS = ("images", "image", "input", "photos", "photographs", "frames")  # folders that a name may begin with


def find_mask(folder: Path, name: str) -> Path | None:
    """Mask of a photograph in a folder of masks, or None."""
    names = (x for own in inner_names(name) for x in (f"{own}.png", PurePosixPath(own).with_suffix(".png")))
    return next((folder / x for x in names if (folder / x).is_file()), None)


def inner_names(name: str) -> Iterator[str]:
    """A photograph's name without leading folders, one after another."""
    path = PurePosixPath(name)
    if path.parts[0] in IMAGE_FOLDERS and len(path.parts) > 1:
        yield PurePosixPath(*path.parts[1:]).as_posix()
    yield path.as_posix()


def with_masks(capture: Capture, folder: Path) -> Capture:
    """The capture with the masks in its folder; a mask of the capture itself takes precedence.

    If some photographs have silhouettes, those without would contradict them: they are left out, and named. Warns if no
    mask is named after a photograph.
    """
    shots, missing = list(capture.shots), list(capture.missing)
    if (folder / MASKS).is_dir():
        shots = [
            shot if shot.mask is not None else replace(shot, mask=find_mask(folder / MASKS, shot.name))
            for shot in shots
        ]
        warn_unmatched(folder / MASKS, any(shot.mask is not None for shot in shots))
    if (folder / OBJECT_MASKS).is_dir():
        found = [replace(shot, alpha=find_mask(folder / OBJECT_MASKS, shot.name)) for shot in shots]
        there = [shot for shot in found if shot.alpha is not None]
        warn_unmatched(folder / OBJECT_MASKS, bool(there))
        if there:
            missing += [f"{OBJECT_MASKS} of {shot.name}" for shot in found if shot.alpha is None]
            shots = there
    if (folder / LABELS).is_dir():
        found = [replace(shot, planes=labelled(folder / LABELS, shot.name) | shot.planes) for shot in shots]
        warn_unmatched(folder / LABELS, any(LABELS in shot.planes for shot in found))
        shots = found
    return replace(capture, shots=shots, missing=missing)


def labelled(folder: Path, name: str) -> dict[str, PixelPlane]:
    """Labels of a photograph in a folder, or an empty dictionary."""
    found = find_mask(folder, name)
    return {} if found is None else {LABELS: PixelPlane(found, "index")}


def warn_unmatched(folder: Path, matched: bool) -> None:
    if not matched and list_images(folder):
        text = (
            f"None of the masks in {folder} is named after a photograph, so they are passed over; call them "
            "image.png or image.jpg.png for image.jpg"
        )
        warnings.warn(text, LumigraphWarning, 3)
