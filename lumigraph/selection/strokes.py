"""Strokes: pixels of one view that a user marks as wanted or unwanted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Int
from PIL import Image
from torch import Tensor

from ..camera import Camera
from ..datasets.images.layer import UNKNOWN_INDEX
from ..errors import LumigraphError
from ..files.reading import reading

WANTED, UNWANTED = (0, 255, 0), (255, 0, 0)  # sRGB bytes: green and red
TOLERANCE = 64  # per channel, for brushes with soft edges
MIN_ALPHA = 128  # of a pixel that counts, where the picture has alpha


@dataclass(frozen=True)
class Strokes:
    """Marked pixels of a camera's picture."""

    camera: Camera
    wanted: Bool[Tensor, "height width"]
    unwanted: Bool[Tensor, "height width"]

    def over(self, segments: Int[Tensor, "height width"]) -> Strokes:
        """Strokes extended to the whole segments that they cross; a segment crossed by both kinds keeps its strokes
        alone."""
        crossed = [set(segments[x].unique().tolist()) - {UNKNOWN_INDEX} for x in (self.wanted, self.unwanted)]
        either = [torch.isin(segments, torch.tensor(sorted(a - b), dtype=segments.dtype)) for a, b in pairs(crossed)]
        return replace(self, wanted=self.wanted | either[0], unwanted=self.unwanted | either[1])


def read_strokes(path: Path, camera: Camera, name: str) -> Strokes:
    """Strokes of a PNG: green pixels are wanted, red ones unwanted; all others, and transparent ones, are ignored.

    camera: of the annotated view; its name is for messages
    Raises LumigraphError for an invalid file, a picture of another size, and one without strokes.
    """
    with reading(path, "is no picture that opens", "give a PNG with green and red strokes"), Image.open(path) as image:
        rgba = np.asarray(image.convert("RGBA"))
    height, width = rgba.shape[:2]
    if [width, height] != camera.size[0].tolist():
        expected = "x".join(map(str, camera.size[0].tolist()))
        raise LumigraphError(
            f"{path} is {width}x{height} pixels, and the view {name} is {expected}; draw on a picture of that size"
        )
    wanted, unwanted = (torch.from_numpy(marked(rgba, colour)) for colour in (WANTED, UNWANTED))
    if not wanted.any() and not unwanted.any():
        raise LumigraphError(f"{path} has no strokes; draw in plain green (wanted) and plain red (unwanted)")
    return Strokes(camera, wanted, unwanted)


def pairs(crossed: list[set[int]]) -> list[tuple[set[int], set[int]]]:
    """Each of two sets with the other one."""
    one, other = crossed
    return [(one, other), (other, one)]


def read_segments(folder: Path, name: str, camera: Camera) -> Int[Tensor, "height width"]:
    """Segments of a photograph, the picture of whole numbers in a folder that is named after it. Raises LumigraphError
    where there is none, and for one of another size."""
    found = next(
        (folder / x for x in (f"{name}.png", f"{Path(name).with_suffix('')}.png") if (folder / x).is_file()), None
    )
    if found is None:
        raise LumigraphError(f"None of the masks in {folder} is named after {name}; call it {Path(name).stem}.png")
    with reading(found, "is no picture that opens", "give a PNG of whole numbers"), Image.open(found) as image:
        values = np.asarray(image)
    values = values[..., :3] @ np.array([1, 256, 65536]) if values.ndim == 3 else values
    if [values.shape[1], values.shape[0]] != camera.size[0].tolist():
        expected = "x".join(map(str, camera.size[0].tolist()))
        raise LumigraphError(f"{found} is {values.shape[1]}x{values.shape[0]} pixels, and its photograph {expected}")
    return torch.from_numpy(values.astype(np.int64))


def marked(rgba: np.ndarray, colour: tuple[int, int, int]) -> Bool[np.ndarray, "height width"]:
    """Pixels of about a colour that are not transparent."""
    near = (np.abs(rgba[..., :3].astype(np.int16) - colour) <= TOLERANCE).all(-1)
    return near & (rgba[..., 3] >= MIN_ALPHA)
