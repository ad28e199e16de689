"""Masks of photographs, by folder name, for every reader.

masks/          training masks: black (0) pixels are ignored, be it a passer-by, a hand or the sky. COLMAP's and
                nerfstudio's meaning.
object_masks/   silhouettes: black pixels are empty, so that the object stands alone. They become the photograph's
alpha.

labels/         class of each pixel, an integer: the layer `labels`. `lumigraph segment` writes such a folder.

A mask is named after its photograph, image.png, image.jpg.png or image_mask.png for image.jpg, and has its shape, at
any size. Masks in other places, whose meaning differs from program to program, are named in a sentence.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath

from ..errors import LumigraphWarning
from ..files import is_file
from .capture import Capture, PixelPlane, Shot
from .pictures import find_file, stem

MASKS, OBJECT_MASKS, LABELS = "masks", "object_masks", "labels"
OTHER_MASKS = "mask", "matting", "segmentation"  # folders of silhouettes, or of the opposite, in other programs
PLANES = (
    "depth",
    "depths",
    "depth_maps",
    "confidence",
    "normals",
    "normal",
    "semantics",
)  # of recordings, no photographs
IMAGE_FOLDERS = ("images", "image", "input", "photos", "photographs", "frames")  # folders that a name may begin with


def find_mask(folder: Path, name: str) -> Path | None:
    """Mask of a photograph in a folder of masks, or None."""
    if not folder.is_dir():
        return None
    ends = [x for own in inner_names(name) for x in (own, stem(own), f"{stem(own)}_mask")]
    files = (*(find_file(folder / x) for x in ends), *(folder / f"{x}.gif" for x in ends))
    return next(filter(is_file, files), None)


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
    if (other := other_masks(shots, folder)) is not None:
        text = (
            f"{other} is not used, for programs disagree on its meaning; put masks whose black pixels are ignored "
            f"into {folder / MASKS}, silhouettes into {folder / OBJECT_MASKS}"
        )
        capture = replace(capture, notes=[*capture.notes, text])
    if (plane := next((folder / x for x in PLANES if (folder / x).is_dir()), None)) and not any(
        x.planes for x in shots
    ):
        text = (
            f"{plane} is not used, for nothing says its unit; name its files in {folder / 'transforms.json'}, as "
            "depth_file_path with depth_unit_scale_factor, or as normals_file_path"
        )
        capture = replace(capture, notes=[*capture.notes, text])
    masks, silhouettes, labels = (in_any_case(folder, name) for name in (MASKS, OBJECT_MASKS, LABELS))
    if masks.is_dir():
        shots = [shot if shot.mask is not None else replace(shot, mask=find_mask(masks, shot.name)) for shot in shots]
        warn_unmatched(masks, any(shot.mask is not None for shot in shots))
    if silhouettes.is_dir():
        found = [replace(shot, alpha=find_mask(silhouettes, shot.name)) for shot in shots]
        there = [shot for shot in found if shot.alpha is not None]
        warn_unmatched(silhouettes, bool(there))
        if there:
            missing += [f"{OBJECT_MASKS} of {shot.name}" for shot in found if shot.alpha is None]
            shots = there
    if labels.is_dir():
        found = [replace(shot, planes=labelled(labels, shot.name) | shot.planes) for shot in shots]
        warn_unmatched(labels, any(LABELS in shot.planes for shot in found))
        shots = found
    return replace(capture, shots=shots, missing=missing)


def in_any_case(folder: Path, name: str) -> Path:
    """The entry of a folder that has a name, in upper or lower case."""
    exact = folder / name
    return exact if exact.exists() else next((x for x in folder.glob("*") if x.name.lower() == name), exact)


def other_masks(shots: list[Shot], folder: Path) -> Path | None:
    """A folder or a file of masks in a place of another program, if no photograph has a mask."""
    files = shots[0].image if shots and shots[0].mask is None else None
    if not isinstance(files, dict):
        return None
    picture = files[min(files)]
    beside = [picture.with_name(f"{name}.png") for name in names_beside(picture.stem)]
    return next((x for x in (*beside, *(folder / name for name in OTHER_MASKS)) if x.exists()), None)


def names_beside(photograph: str) -> tuple[str, ...]:
    """Names, without suffix, that other programs give to the mask beside a photograph."""
    return f"{photograph}_mask", f"{photograph}.mask", f"dynamic_mask_{photograph}"


def labelled(folder: Path, name: str) -> dict[str, PixelPlane]:
    """Labels of a photograph in a folder, or an empty dictionary."""
    found = find_mask(folder, name)
    return {} if found is None else {LABELS: PixelPlane(found, "index")}


def warn_unmatched(folder: Path, matched: bool) -> None:
    if not matched and (found := next((x for x in sorted(folder.rglob("*")) if x.is_file()), None)):
        text = (
            f"None of the masks in {folder}, such as {found.name}, is named after a photograph; they are passed over. "
            "Call them image.png or image.jpg.png for image.jpg"
        )
        warnings.warn(text, LumigraphWarning, 3)
